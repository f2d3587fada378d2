"""Description of a readout chain: preamplifier, noise, digitiser and disturbances.

Its linear circuits are sums of exponentials, combined by partial fractions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from cpunet.settings import Config, Fraction, NonNegative, Positive, Set, read_settings

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

REFERENCE_KEV = 2614.5
"""Energy (keV) of the full-energy peak, at which energy-dependent values are quoted."""

MAX_RATE_KHZ = 1000.0  # a pulse per microsecond, far beyond any detector
MAX_JITTER_NS = 1e6  # longer than records; traces are followed from the start of the pulse
MAX_SAMPLES = 100_000  # of a record, far beyond any digitiser
# Equal time constants are separated by this relative amount. A sum of single poles then
# represents a multiple pole: a step response changes by less than 1e-6 of its height, while
# the residues of even four equal poles keep eight digits.
_APART = 1e-3


@dataclass(frozen=True, eq=False)
class Exponentials:
    r"""A transfer function with distinct poles.

    .. math:: H(s) = d + \sum_k \frac{\rho_k}{s - p_k}

    Its step response is a sum of exponentials,

    .. math:: r(t) = d + \sum_k \frac{\rho_k}{p_k} \left(e^{p_k t} - 1\right).

    Parameters
    ----------
    direct
        Instantaneous part :math:`d`, dimensionless.
    poles, residues
        Complex arrays :math:`p_k` and :math:`\rho_k` of the same length, in 1/ns.

    Examples
    --------
    >>> two = Exponentials.low_pass(40.0) * Exponentials.low_pass(60.0)
    >>> two.step(np.array([-1.0, 0.0, 1e4])).round(6).tolist()
    [0.0, 0.0, 1.0]

    One RC integration responds to a step with :math:`1 - e^{-t/\tau}`.

    >>> bool(abs(Exponentials.low_pass(40.0).step(40.0) - (1 - np.exp(-1))) < 1e-15)
    True
    """

    direct: float
    poles: ComplexArray
    residues: ComplexArray

    @classmethod
    def of_step(
        cls, final: float, fractions: Sequence[float], taus_ns: Sequence[float]
    ) -> Exponentials:
        r"""Circuit with a step response of :math:`r_\infty + \sum_i f_i e^{-t/\tau_i}`."""
        taus = np.array(taus_ns, np.complex128)
        return cls(final + sum(fractions), -1 / taus, -np.array(fractions) / taus)

    @classmethod
    def low_pass(cls, tau_ns: float, fraction: float = 1.0) -> Exponentials:
        r"""RC integration of a `fraction` of the step: :math:`1 - f e^{-t/\tau}`."""
        return cls.of_step(1.0, [-fraction], [tau_ns])

    def at(self, s: ComplexArray) -> ComplexArray:
        """Evaluate ``H(s)`` at `s` in 1/ns. `s` must not be a pole."""
        parts = self.residues / (np.asarray(s, np.complex128)[..., None] - self.poles)
        return np.asarray(self.direct + parts.sum(axis=-1))

    def __mul__(self, other: Exponentials) -> Exponentials:
        """Cascade two circuits. They must not share a pole."""
        residues = self.residues * other.at(self.poles), other.residues * self.at(other.poles)
        poles = np.concatenate([self.poles, other.poles])
        return Exponentials(self.direct * other.direct, poles, np.concatenate(residues))

    def step(self, t_ns: npt.ArrayLike) -> FloatArray:
        """Response to a unit step at 0, at times in ns; zero before it."""
        t, weights = np.asarray(t_ns, float), self.residues / self.poles
        modes = np.expm1(np.maximum(t, 0)[..., None] * self.poles) * weights
        return np.where(t >= 0, self.direct + modes.sum(axis=-1).real, 0.0)


def moved_apart(taus_ns: Sequence[float]) -> list[float]:
    """Separate time constants that agree within 0.1 %, about their mean; keep the order.

    Examples
    --------
    >>> [round(tau, 3) for tau in moved_apart([40.0, 500.0, 40.0])]
    [39.98, 500.0, 40.02]
    """
    order = np.argsort(taus_ns, kind="stable")
    values, start = np.array(taus_ns, float)[order], np.arange(len(order))
    moved = values.copy()
    for i in range(len(values)):
        first = i  # of a group; the more values it has, the farther it reaches
        while first and moved[first] < (1 + _APART) * moved[first - 1]:
            first = start[first - 1]
            steps = np.arange(first, i + 1) - (first + i) / 2
            moved[first : i + 1] = values[first : i + 1].mean() * (1 + _APART * steps)
        start[i] = first
    return [float(tau) for tau in moved[np.argsort(order)]]


class SlowPart(Config):
    """A `fraction` of the charge that arrives with the time constant `tau_ns`."""

    fraction: Fraction
    tau_ns: Positive


class Ringing(Config):
    r"""Damped oscillation added to a unit step.

    .. math:: f\, e^{-t / \tau_d} \sin(2 \pi \nu t)

    with the fraction :math:`f`, the damping time :math:`\tau_d` and the frequency
    :math:`\nu`. The bandwidth stages act after it and attenuate it.
    """

    frequency_MHz: Positive
    fraction: Fraction
    damping_ns: Positive


class Decay(Config):
    """A `fraction` of the step that decays with the time constant `tau_us`."""

    fraction: Annotated[float, Field(gt=0, le=1)]
    tau_us: Positive


class NoiseLine(Config):
    """A narrow line in the noise: its frequency and its fraction of the noise power."""

    frequency_MHz: Positive
    power_fraction: Fraction


class NoiseSpectrum(Config):
    r"""Shape of the noise power spectrum.

    A flat continuum with a high-frequency roll-off and a low-frequency excess,

    .. math:: P(\nu) \propto \frac{1 + e / (1 + (\nu/\nu_e)^2)}{1 + (\nu/\nu_c)^m},

    plus narrow lines. :math:`\nu_c` is `corner_MHz`, :math:`m` is `order`, :math:`e` is
    `excess` and :math:`\nu_e` is `excess_corner_kHz`.
    """

    corner_MHz: Positive
    order: Positive
    excess: NonNegative
    excess_corner_kHz: Positive
    lines: tuple[NoiseLine, ...] = ()


class ReadoutNoise(Config):
    """Noise with an RMS of `rms_kev` and a spectrum, independent of the pulse energy.

    The RMS is that of single samples, at whatever period. The spectrum ends near its corner,
    which periods up to some 30 ns can follow; longer ones would average over the noise, so
    that a lower RMS belongs to them.
    """

    rms_kev: NonNegative
    spectrum: NoiseSpectrum


class Nonlinearity(Config):
    """What a digitiser adds to a height, as a fraction of its range: a sine of some waves."""

    fraction: Fraction
    waves: Annotated[int, Field(ge=1, le=20)]


class OtherPulses(Config):
    """Rate of the pulses before a trace, or within its record."""

    rate_kHz: Annotated[float, Field(ge=0, le=MAX_RATE_KHZ)]


class Electronics(Config):
    """A readout chain.

    Parameters
    ----------
    name, description
        Used in messages and in ``stand.json``.
    bandwidth_poles_ns
        Time constants of one to four RC integrations in ns.
    slow
        A delayed part of the charge, or null.
    overshoot
        A step that starts too high by a fraction and relaxes with a time constant, or null.
    ringing
        A damped oscillation, or null.
    decays
        Components of the preamplifier decay. Their fractions add up to 1.
    gain_adc_per_kev
        Gain in ADC counts per keV.
    noise
        RMS and spectrum of the noise.
    baseline_mean_adc, baseline_spread_adc
        Mean and standard deviation of the Gaussian distribution of baselines, in ADC counts.
    trigger_jitter_ns
        RMS of the trigger time in ns, in addition to the uniform phase of the clock.
    earlier_pulses, pile_up
        Other pulses before and within the record, as Poisson processes.
    other_pulses_kev
        Quantiles of the energies of other pulses in keV, evenly spaced in probability from
        the minimum to the maximum. The logarithm is interpolated linearly between them.
    adc_bits
        Resolution of the digitiser. Samples saturate at ``2**adc_bits - 1``.
    resolution_fwhm_kev
        FWHM of the calibrated energies at 2614.5 keV. It scales with the square root of the
        energy.
    before_ns, record_ns
        Time before the pulse and of the whole record in ns, which are rounded to whole samples.
    dt_ns
        Sampling period in ns, 1 to 200. A sample is the mean over one period.
    slew_kev_per_ns
        Rate of an amplifier's output that it cannot exceed, or null; a step of d keV per period
        becomes ``s tanh(d / s)`` of the limit s.
    nonlinearity
        Integral non-linearity of the digitiser: fraction of its range by which counts are off,
        and waves of the sine that they follow over the range; null for none.
    """

    name: str
    description: str
    bandwidth_poles_ns: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=4)]
    slow: SlowPart | None
    overshoot: SlowPart | None
    ringing: Ringing | None
    decays: Annotated[tuple[Decay, ...], Field(min_length=1, max_length=4)]
    gain_adc_per_kev: Positive
    noise: ReadoutNoise
    baseline_mean_adc: NonNegative
    baseline_spread_adc: NonNegative
    trigger_jitter_ns: Annotated[float, Field(ge=0, le=MAX_JITTER_NS)]
    earlier_pulses: OtherPulses
    pile_up: OtherPulses
    other_pulses_kev: Annotated[tuple[Positive, ...], Field(min_length=2)]
    adc_bits: Annotated[int, Field(ge=8, le=16)]
    resolution_fwhm_kev: NonNegative
    before_ns: Positive
    record_ns: Positive
    dt_ns: Annotated[float, Field(ge=1, le=200)]
    slew_kev_per_ns: Positive | None = None
    nonlinearity: Nonlinearity | None = None

    @model_validator(mode="after")
    def _is_possible(self) -> Electronics:
        total, fault = sum(part.fraction for part in self.decays), ""
        nyquist_MHz, lines = 500 / self.dt_ns, self.noise.spectrum.lines
        if abs(total - 1) > 1e-6:
            fault = f"decays: their fractions add up to {total:g}; they must to 1"
        elif list(self.other_pulses_kev) != sorted(self.other_pulses_kev):
            fault = "other_pulses_kev: quantiles of energies must not fall"
        elif self.record_ns > MAX_SAMPLES * self.dt_ns:
            fault = f"record_ns: more than {MAX_SAMPLES} samples; lower it"
        elif not 0 < self.n_pre < self.length:
            fault = "before_ns must be at least dt_ns and less than record_ns"
        elif self.baseline_mean_adc >= self.adc_top:
            fault = f"baseline_mean_adc must be below {self.adc_top}, the most of adc_bits"
        elif sum(line.power_fraction for line in lines) >= 1:
            fault = "noise.lines: their power_fraction must add up to less than 1"
        elif any(line.frequency_MHz >= nyquist_MHz for line in lines):
            fault = f"noise.lines: beyond {nyquist_MHz:g} MHz, half the sampling rate; leave "
            fault += "them out or lower dt_ns"
        if fault:
            raise ValueError(fault)
        return self

    @property
    def n_pre(self) -> int:
        """Number of samples before the pulse."""
        return round(self.before_ns / self.dt_ns)

    @property
    def length(self) -> int:
        """Number of samples of the record."""
        return round(self.record_ns / self.dt_ns)

    @property
    def adc_top(self) -> int:
        """Highest ADC count."""
        return int(2**self.adc_bits - 1)

    @property
    def transfer(self) -> Exponentials:
        r"""The chain as a sum of exponentials.

        .. math:: H(s) = \Big[\sum_i f_i \frac{s\tau_i}{1 + s\tau_i}\Big]
            \Big[1 - f_s \frac{s\tau_s}{1 + s\tau_s}\Big]
            \Big[1 + f_o \frac{s\tau_o}{1 + s\tau_o}\Big]
            \Big[1 + f_r \frac{s\,\omega}{(s + 1/\tau_d)^2 + \omega^2}\Big]
            \prod_j \frac{1}{1 + s\tau_j}

        The factors are the decays, the slow part, the overshoot, the ringing
        (:math:`\omega = 2\pi\nu`) and the bandwidth poles. Stages that are null drop out.

        Examples
        --------
        >>> from cpunet.electronics.chain import read_electronics
        >>> bool(abs(read_electronics("ornl").transfer.at(0)) < 1e-12)  # no constant current
        True
        """
        # a slow part is missing at first, an overshoot is in excess
        parts = [(self.slow, 1), (self.overshoot, -1)]
        stages = [(part.tau_ns, sign * part.fraction) for part, sign in parts if part]
        stages += [(tau_ns, 1.0) for tau_ns in self.bandwidth_poles_ns]
        decays_ns = [1e3 * part.tau_us for part in self.decays]
        taus = moved_apart([*(tau for tau, _ in stages), *decays_ns])
        n, shares = len(stages), [part.fraction for part in self.decays]
        chain = Exponentials.of_step(0.0, shares, taus[n:])
        for (_, fraction), tau in zip(stages, taus, strict=False):
            chain = chain * Exponentials.low_pass(tau, fraction)
        if ring := self.ringing:
            pole = complex(-1 / ring.damping_ns, 2 * np.pi * ring.frequency_MHz * 1e-3)
            both = np.array([pole, pole.conjugate()])
            chain = chain * Exponentials(1.0, both, ring.fraction * both / np.array([2j, -2j]))
        return chain


_PRESETS = Path(__file__).parent / "presets"


def read_electronics(path: str | Path | Electronics, overrides: Set = ()) -> Electronics:
    """Read a readout chain.

    Parameters
    ----------
    path
        Name of a preset (ornl, legend200, ringing, mjd) or a YAML file with the fields of
        `Electronics`. Or a readout chain, for overrides.
    overrides
        Values as ``"earlier_pulses.rate_kHz=3"``.

    Raises
    ------
    CpunetError
        If the file cannot be read or the chain is invalid. The message names the field.

    Examples
    --------
    >>> read_electronics("ornl").decays[0].tau_us
    54.6
    >>> read_electronics("ornl", ["earlier_pulses.rate_kHz=3"]).earlier_pulses.rate_kHz
    3.0
    >>> read_electronics("ornl").length, read_electronics("ornl", ["dt_ns=10"]).length
    (1400, 2240)
    """
    return read_settings(Electronics, path, overrides, _PRESETS)
