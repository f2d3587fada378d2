"""A readout chain in figures: preamplifier, noise, digitiser, and what else is in a trace."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy.typing as npt
from pydantic import ConfigDict, Field, model_validator

from cpunet.electronics.exponentials import Exponentials, FloatArray, moved_apart
from cpunet.recipes.base import Config, Fraction, NonNegative, Positive, Samples

REFERENCE_KEV = 2614.5
"""Energy (keV) at which figures that depend on it are given: the full-energy peak."""

_Share = Annotated[float, Field(gt=0, le=1)]


class _Figures(Config):
    model_config = ConfigDict(allow_inf_nan=False)


class SlowPart(_Figures):
    """A `fraction` of the charge arrives with a time constant of its own."""

    fraction: Fraction
    tau_ns: Positive


class Ringing(_Figures):
    """Oscillation added to a step, ``fraction exp(-t/damping) sin(2 pi frequency t)``.

    The bandwidth, which comes after it, weakens it.
    """

    frequency_MHz: Positive
    fraction: Fraction
    damping_ns: Positive


class Decay(_Figures):
    """A `fraction` of the step decays with `tau_us`."""

    fraction: _Share
    tau_us: Positive


class NonLinearity(_Figures):
    """Departures from a linear chain.

    ``quadratic_fraction``: a signal of 2614.5 keV comes out taller by this fraction, others
    in proportion to their height squared.  ``slew_kev_per_ns``: fastest change; null: none.
    """

    quadratic_fraction: Annotated[float, Field(gt=-0.5, lt=0.5)]
    slew_kev_per_ns: Positive | None


class NoiseLine(_Figures):
    """A narrow line: its frequency, and its share of the noise power."""

    frequency_MHz: Positive
    power_fraction: Fraction


class NoiseSpectrum(_Figures):
    """Shape of the power: flat, with a roll-off, an excess at low frequency, and lines.

    ``(1 + excess / (1 + (f/excess_corner)²)) / (1 + (f/corner)^order)``
    """

    corner_MHz: Positive
    order: Positive
    excess: NonNegative
    excess_corner_kHz: Positive
    lines: tuple[NoiseLine, ...] = ()

    @model_validator(mode="after")
    def _continuum_remains(self) -> NoiseSpectrum:
        if sum(line.power_fraction for line in self.lines) >= 1:
            raise ValueError("lines: their power_fraction must add up to less than 1")
        return self


class Noise(_Figures):
    """Noise of `rms_kev`, the same at all energies: from a spectrum, or cut from a file.

    ``baselines_file`` holds measured traces without pulses, at least as long as the record;
    they are scaled to `rms_kev`.
    """

    rms_kev: NonNegative
    spectrum: NoiseSpectrum | None = None
    baselines_file: Path | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Noise:
        if (self.spectrum is None) == (self.baselines_file is None):
            raise ValueError("give either a spectrum or a baselines_file")
        return self


class EarlierPulses(_Figures):
    """Pulses before the record, at random at a rate: their tails are under its traces."""

    rate_kHz: NonNegative


class PileUp(_Figures):
    """Second pulses in the record, at a rate."""

    rate_kHz: NonNegative


class Hum(_Figures):
    """A wave of the mains under all traces, at any phase."""

    frequency_Hz: Positive
    amplitude_kev: Positive


class Electronics(_Figures):
    """A readout chain.

    Parameters
    ----------
    name, description
        For messages and ``stand.json``.
    bandwidth_poles_ns
        Time constants of RC integrations, one to four.
    slow, overshoot, ringing
        Further stages, or null: a slow part of the charge; a step that begins too high by
        a fraction, and comes down with a time constant; an oscillation.
    decays
        Parts of the step's decay; their fractions add up to 1.
    gain_adc_per_kev, non_linearity
        ADC counts per keV, and departures from it (null: none).
    noise
        Its size and spectrum.
    baseline_mean_adc, baseline_spread_adc
        Baseline of a trace, Gaussian from trace to trace.
    trigger_jitter_ns
        RMS of the time of the pulse in the record, beside the clock's random phase.
    earlier_pulses, pile_up
        Other pulses, by Poisson processes: before the record and in it.
    other_pulses_kev
        Quantiles of their energies, evenly spaced from the lowest to the highest; between
        them the logarithm is taken as linear.
    hum
        A slow wave, or null.
    adc_bits
        Samples beyond ``2**adc_bits - 1`` stay there.
    resolution_fwhm_kev
        Of the calibrated energies at 2614.5 keV; in proportion to the root of the energy.
    n_pre, length
        Samples before the pulse, and in the record.
    dt_ns
        Sampling period; a sample is the mean over it.
    """

    name: str
    description: str
    bandwidth_poles_ns: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=4)]
    slow: SlowPart | None
    overshoot: SlowPart | None
    ringing: Ringing | None
    decays: Annotated[tuple[Decay, ...], Field(min_length=1, max_length=4)]
    gain_adc_per_kev: Positive
    non_linearity: NonLinearity | None
    noise: Noise
    baseline_mean_adc: NonNegative
    baseline_spread_adc: NonNegative
    trigger_jitter_ns: NonNegative
    earlier_pulses: EarlierPulses
    pile_up: PileUp
    other_pulses_kev: Annotated[tuple[Positive, ...], Field(min_length=2)]
    hum: Hum | None = None
    adc_bits: Annotated[int, Field(ge=8, le=16)]
    resolution_fwhm_kev: NonNegative
    n_pre: Samples
    length: Samples
    dt_ns: Annotated[float, Field(ge=0.1, le=1e6)]

    @model_validator(mode="after")
    def _is_possible(self) -> Electronics:
        total = sum(part.fraction for part in self.decays)
        if abs(total - 1) > 1e-6:
            raise ValueError(f"decays: their fractions add up to {total:g}; they must to 1")
        if list(self.other_pulses_kev) != sorted(self.other_pulses_kev):
            raise ValueError("other_pulses_kev: quantiles of energies must not fall")
        if self.n_pre >= self.length:
            raise ValueError("n_pre must be less than length, or no pulse is in the record")
        if self.baseline_mean_adc >= self.adc_top:
            raise ValueError(
                f"baseline_mean_adc must be below {self.adc_top}, the most of adc_bits"
            )
        nyquist_MHz = 500 / self.dt_ns
        spectrum = self.noise.spectrum
        if spectrum and any(line.frequency_MHz >= nyquist_MHz for line in spectrum.lines):
            raise ValueError(f"noise.lines: beyond {nyquist_MHz:g} MHz, half the sampling rate")
        return self

    def disturbed(
        self,
        rate_khz: float | None = None,
        pile_up_khz: float | None = None,
        hum: Hum | None = None,
    ) -> Electronics:
        """The same chain with other rates of earlier and of second pulses, or with a hum.

        Examples
        --------
        >>> from cpunet.electronics.presets import read_electronics
        >>> read_electronics("ornl").disturbed(rate_khz=3).earlier_pulses.rate_kHz
        3.0
        """
        changes: dict[str, object] = {}
        if rate_khz is not None:
            changes["earlier_pulses"] = EarlierPulses(rate_kHz=rate_khz)
        if pile_up_khz is not None:
            changes["pile_up"] = PileUp(rate_kHz=pile_up_khz)
        if hum is not None:
            changes["hum"] = hum
        return self.model_copy(update=changes)

    @property
    def adc_top(self) -> int:
        """The highest ADC count."""
        return int(2**self.adc_bits - 1)

    @property
    def times_ns(self) -> dict[str, float]:
        """The fastest time of each stage in ns, by the field that gives it."""
        times = {"bandwidth_poles_ns": min(self.bandwidth_poles_ns)}
        if self.slow:
            times["slow.tau_ns"] = self.slow.tau_ns
        if self.overshoot:
            times["overshoot.tau_ns"] = self.overshoot.tau_ns
        if self.ringing:
            # an oscillation is followed if a radian of it is
            times["ringing.frequency_MHz"] = 1e3 / (2 * 3.1416 * self.ringing.frequency_MHz)
            times["ringing.damping_ns"] = self.ringing.damping_ns
        times["decays.tau_us"] = 1e3 * min(part.tau_us for part in self.decays)
        return times

    @cached_property
    def transfer(self) -> Exponentials:
        """The chain's linear part as a sum of exponentials.

        Examples
        --------
        >>> from cpunet.electronics.presets import read_electronics
        >>> bool(abs(read_electronics("ornl").transfer.at(0)) < 1e-12)  # no constant current
        True
        """
        single = [part for part in (self.slow, self.overshoot) if part]
        taus = moved_apart(
            [
                *self.bandwidth_poles_ns,
                *(part.tau_ns for part in single),
                *(1e3 * part.tau_us for part in self.decays),
            ]
        )
        n_poles, n_decays = len(self.bandwidth_poles_ns), len(self.decays)
        chain = Exponentials.decaying(
            [part.fraction for part in self.decays], taus[len(taus) - n_decays :]
        )
        for part, tau in zip(single, taus[n_poles:], strict=False):
            # a slow part is missing at first, an overshoot is too much
            sign = -1 if part is self.overshoot else 1
            chain = chain * Exponentials.mixed(sign * part.fraction, tau)
        for tau in taus[:n_poles]:
            chain = chain * Exponentials.low_pass(tau)
        if self.ringing:
            ring = self.ringing
            chain = chain * Exponentials.ringing(
                ring.fraction, ring.frequency_MHz, ring.damping_ns
            )
        return chain

    def step_response(self, t_ns: npt.ArrayLike) -> FloatArray:
        """What a unit of charge at 0 looks like at times `t_ns`; 0 before.

        Examples
        --------
        >>> from cpunet.electronics.presets import read_electronics
        >>> read_electronics("legend200").step_response([-16, 0, 1000]).round(2).tolist()
        [0.0, 0.0, 0.99]
        """
        return self.transfer.step(t_ns)

    def impulse_response(self, t_ns: npt.ArrayLike) -> FloatArray:
        """Derivative of the step response in 1/ns at times `t_ns`."""
        return self.transfer.impulse(t_ns)
