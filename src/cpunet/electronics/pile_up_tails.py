r"""Pile-up tails under raw traces, from the level and slope of their baselines.

A tail of height :math:`A` above the level of an empty baseline follows
:math:`A e^{-t/\tau}`. It raises the baseline and tilts it. With a DC-coupled amplifier the
*level* is the more precise measure, since levels vary little between traces. Level and slope
are weighted by their errors. These come from the lower side of each distribution, which the
tails do not affect. Large tails also give the decay time: the means of the two halves of
their baselines, after a time :math:`h`, have a ratio of :math:`e^{h/\tau}`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field
from scipy.stats import median_abs_deviation

from cpunet.electronics.exponentials import FloatArray
from cpunet.electronics.tails_law import RateFit, TailsLaw, fit_rate, tail_shape
from cpunet.errors import CpunetError
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import InfoPart

MIN_BASELINES = 30  # minimum number of baselines
SIGMA_PER_MAD = 1.4826  # of a normal distribution
MIN_LARGE = 20  # minimum number of large tails to determine coupling and decay time
# A baseline whose level differs by more than this factor from what its tilt implies is not
# that of a tail.
COUPLED = 2.5
# Number of Gaussian standard deviations of the residual RMS beyond which a baseline holds
# another pulse.
DISTURBED = 6.0
MIN_SAMPLES = 64  # minimum length of a baseline
LARGE = 12.0  # minimum height in errors of tails used for the decay time
# If a larger fraction of traces has tails above the error, noise is measured only from
# traces with tails below 0, at the cost of half of the noise.
MANY = 0.1
LEVEL_TELLS = 0.2  # weight of the level above which it identifies empty baselines
# The rate is significant above SURE errors, with a log-likelihood gain above SURE_GAIN.
SURE, SURE_GAIN = 4.0, 12.0
# Maximum fraction of traces with a tail larger than the error, at a significant rate or not.
MAX_FULL, MAX_UNSURE = 0.97, 0.5
SHARES_KEV = (10.0, 30.0, 100.0, 300.0)  # thresholds at which fractions are reported


def usable(baselines: Baselines) -> tuple[FloatArray, float, float]:
    """Baselines of one length, the gain in ADC counts per keV, and the decay of tails in us.

    Raises
    ------
    CpunetError
        If too few traces can be prepared or have a known energy, the baselines are too short,
        or the pulses do not decay.
    """
    prepared, length = baselines.prepared, baselines.length
    if len(prepared) < MIN_BASELINES:
        reasons = ", ".join(f"{n} {reason}" for reason, n in prepared.rejections.items())
        raise CpunetError(
            f"only {len(prepared)} of {len(baselines)} traces can be prepared "
            f"({reasons or 'there are no more'}); {MIN_BASELINES} or more are needed to tell "
            "pile-up tails"
        )
    if length < MIN_SAMPLES:
        raise CpunetError(
            f"the traces have {length} samples before the pulse; pile-up tails "
            f"need {MIN_SAMPLES} or more, so give traces with a longer baseline"
        )
    with np.errstate(divide="ignore"):  # an energy of 0 is left out
        gains = baselines.height / prepared.pulses.energy_kev
    gains = gains[np.isfinite(gains) & (gains > 0)]
    if len(gains) < MIN_BASELINES:
        raise CpunetError(
            f"only {len(gains)} traces have a known energy and can be prepared; "
            f"{MIN_BASELINES} or more are needed to tell pile-up tails in keV"
        )
    large = prepared.scale >= np.median(prepared.scale)
    slope = float(np.median(prepared.tail_slope[large]))
    if not slope < 0:
        raise CpunetError(
            "the tails of the traces do not decay, so earlier pulses leave no trace; "
            "are these measured traces?"
        )
    values = baselines.first.waveforms[:, :length].astype(float)
    return values, float(np.median(gains)), -1e3 / slope


def read_baselines(
    baselines: FloatArray, dt_ns: float, decay_us: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    r"""Mean of each baseline, the tail from its tilt, and the residual RMS.

    The tail is the least-squares height :math:`A` of

    .. math:: b_j = c + A e^{-t_j / \tau},

    with a free level :math:`c`. Its height refers to the first sample.

    Parameters
    ----------
    baselines
        First samples of the traces, shape ``(n, samples)``.
    dt_ns
        Sampling period in ns.
    decay_us
        Decay time in us.

    Returns
    -------
    tuple of array
        Mean, tail and RMS in the units of the baselines, each of shape ``(n,)``.

    Examples
    --------
    >>> tail = 100 + 7 * np.exp(-np.arange(500) * 0.016 / 50)
    >>> _, left, width = read_baselines(tail[np.newaxis], 16.0, 50.0)
    >>> round(float(left[0]), 6), bool(width[0] < 1e-9)
    (7.0, True)
    """
    shape = tail_shape(baselines.shape[1], dt_ns, decay_us)
    lever = shape - shape.mean()
    with np.errstate(invalid="ignore", over="ignore"):
        mean = baselines.mean(axis=1)
        left = baselines @ lever / (lever @ lever)
        width = (baselines - mean[:, np.newaxis] - left[:, np.newaxis] * lever).std(axis=1)
    return mean, left, np.where(np.isfinite(width), width, np.inf)


def mode(values: FloatArray) -> float:
    """Mode of a one-sided distribution, by repeatedly halving the shortest half."""
    ordered = np.sort(values)
    while len(ordered) > 8:
        half = len(ordered) // 2
        first = int(np.argmin(ordered[half:] - ordered[: len(ordered) - half]))
        ordered = ordered[first : first + half + 1]
        if ordered[-1] == ordered[0]:
            break
    return float(ordered.mean())


def lower_spread(values: FloatArray) -> float:
    """Standard deviation of the side below 0, which tails do not affect."""
    below = -values[values <= 0]
    return max(float(SIGMA_PER_MAD * np.median(below)) if len(below) else 0.0, 1e-9)


class TailsInfo(InfoPart):
    """What was measured of pile-up tails, or why it is `missing`, and what to draw them from.

    The measured fractions of traces include the effect of the measurement error. Those of the
    law do not.
    """

    rate_khz: float = 0.0
    drawn: dict[str, Any] | None = None
    rate_error_khz: float = 0.0
    decay_us: float = 0.0
    decay_error_us: float | None = None
    error_kev: float = 0.0
    told_by: str = ""
    energies: str = ""
    traces: int = 0
    percent_above: dict[str, dict[str, float]] = Field(default_factory=dict)
    missing: str | None = None

    def in_words(self) -> list[tuple[str, str]]:
        """Names and texts."""
        if not self.rate_khz:
            return [("pile-up tails", "none significant")]
        shares = ", ".join(
            f"{share['measured']:.2g} % above {size.partition('_')[0]} keV"
            for size, share in self.percent_above.items()
        )
        rate = f"{self.rate_khz:.3g} ± {self.rate_error_khz:.2g} kHz"
        by = f"estimated from {self.told_by}, error {self.error_kev:.2g} keV"
        return [
            ("pile-up tails", f"{rate}, decaying with {self.decay_us:.3g} µs"),
            ("", f"{shares} ({by})"),
        ]


@dataclass(frozen=True, eq=False)
class PileUpTails:
    """Tails measured under the traces of a channel, and their law.

    Parameters
    ----------
    kev
        Tail at the first sample of each measured trace in keV. NaN where it cannot be
        determined.
    level_weight
        Weight of the tail from the level; 0 if levels do not follow the tails. That of the
        slope is the complement.
    level_error_kev
        Standard deviation of the tail from the level alone, in keV.
    decay_us, decay_error_us
        Decay time of the tails and its error in us. The error is None if the decay time
        is that of the pulses' tails.
    level_adc, adc_per_kev
        Most frequent level of a baseline in ADC counts, and gain in ADC counts per keV.
    widest_adc
        Maximum RMS, about its tail, of a baseline without another pulse.
    fit
        Fit of the law.
    samples
        Number of samples used of each baseline.
    dt_ns
        Sampling period in ns.
    """

    kev: FloatArray
    level_weight: float
    level_error_kev: float
    decay_us: float
    decay_error_us: float | None
    level_adc: float
    adc_per_kev: float
    widest_adc: float
    fit: RateFit
    samples: int
    dt_ns: float

    def empty(self, raw: Pulses) -> npt.NDArray[np.bool_]:
        """Select traces without tails, from whose baselines noise can be measured.

        If levels are precise, these are the traces with a level close to that of an empty
        baseline. No condition is placed on the slopes, so that noise alone determines them.
        Otherwise, if many traces have tails, those with a measured tail of 0 or less are
        selected: by symmetry, the noise on this side has the power of all noise, while tails
        are mostly on the other side. If few traces have tails, all are selected.
        """
        if self.level_weight >= LEVEL_TELLS:
            shape = tail_shape(self.samples, self.dt_ns, self.decay_us).mean()
            above_kev = self.fit.level_kev / self.level_weight + self.level_error_kev
            highest = self.level_adc + above_kev * self.adc_per_kev * shape
            return np.asarray(raw.waveforms[:, : self.samples].mean(axis=1) < highest)
        if float(self.fit.law.share_above(self.fit.sigma_kev)) < MANY:
            return np.ones(len(raw), bool)
        return np.asarray(np.nan_to_num(self.measure(raw), nan=np.inf) <= 0)

    @property
    def law(self) -> TailsLaw | None:
        """The law, or None if the tails are not significant."""
        sure = self.fit.law.rate_khz > SURE * self.fit.rate_error_khz
        return self.fit.law if sure and self.fit.gain_of_law > SURE_GAIN else None

    @classmethod
    def of(cls, baselines: Baselines, decay_us: float | None = None) -> PileUpTails:
        """Measure the tails under raw traces and fit their law.

        Parameters
        ----------
        baselines
            Baselines of measured traces of one channel, from any mixture of peaks.
        decay_us
            Decay time of the preamplifier in us, if given. Otherwise it is taken from large
            tails or, if there are none, from the tails of the pulses.

        Raises
        ------
        CpunetError
            If the baselines are too short, the energies are unknown, or too few traces can
            be used.
        """
        values, gain, tail_decay = usable(baselines)
        dt_ns, samples = baselines.first.dt_ns, values.shape[1]
        decay, error = decay_us or tail_decay, None
        mean, left, quiet, widest = _read(values, dt_ns, decay)
        level = mode(mean[quiet])
        tilted = quiet & (left > LARGE * lower_spread(left[quiet]))
        large, coupled = values[tilted] - level, False
        if len(large) >= MIN_LARGE:  # with DC coupling they are as high as their tilt implies
            high = large[:, : samples // 4].mean(axis=1) / left[tilted]
            coupled = 1 / COUPLED < float(np.median(high)) < COUPLED
        if coupled and decay_us is None:  # by their means over both halves
            half = samples // 2
            first, second = large[:, :half].mean(axis=1), large[:, half : 2 * half].mean(axis=1)
            positive = (first > 0) & (second > 0)
            fall = np.log(first[positive] / second[positive])
            if len(fall) >= MIN_LARGE and (middle := float(np.median(fall))) > 0:
                decay = half * dt_ns * 1e-3 / middle
                spread = 1.2533 * float(median_abs_deviation(fall, scale="normal"))
                error = decay * spread / middle / float(np.sqrt(len(fall)))
                mean, left, quiet, widest = _read(values, dt_ns, decay)
        # tails by slope and by level, weighted by their errors
        of_slope = left / gain
        of_level = (mean - level) / (tail_shape(samples, dt_ns, decay).mean() * gain)
        slope_error = lower_spread(of_slope[quiet])
        level_error = lower_spread(of_level[quiet]) if coupled else np.inf
        weight = slope_error**2 / (slope_error**2 + level_error**2) if coupled else 0.0
        kev = (1 - weight) * of_slope + weight * of_level
        guess = (slope_error**-2.0 + level_error**-2.0) ** -0.5
        fit = fit_rate(kev[quiet], guess, decay, baselines.first.energy_kev)
        kev = np.where(quiet, kev - fit.level_kev, np.nan)
        tails = cls(
            kev, weight, level_error, decay, error, level, gain, widest, fit, samples, dt_ns
        )
        # with many tails and no precise rate, the level of empty baselines is not seen either
        most = MAX_FULL if tails.law else MAX_UNSURE
        if float(fit.law.share_above(fit.sigma_kev)) > most:
            raise CpunetError(
                "nearly all traces lie on pile-up tails, so that the level of an empty "
                "baseline is not seen and they cannot be measured; measure at a lower rate"
            )
        return tails

    def measure(self, raw: Pulses) -> FloatArray:
        r"""Tail at the first sample of raw traces in keV; NaN where undetermined.

        It is the weighted mean of the tails from slope and level,

        .. math:: A = (1 - w)\, A_{\mathrm{slope}} + w\, \frac{\bar{b} - b_0}{\bar{e}} - A_0,

        with the mean :math:`\bar{b}` of the baseline, the most frequent one :math:`b_0`, the
        mean :math:`\bar{e}` of :math:`e^{-t/\tau}` over the baseline, and the fitted level
        :math:`A_0` of empty baselines.
        """
        baselines = np.asarray(raw.waveforms[:, : self.samples], float)
        mean, left, width = read_baselines(baselines, self.dt_ns, self.decay_us)
        shape = tail_shape(self.samples, self.dt_ns, self.decay_us).mean()
        of_level, weight = (mean - self.level_adc) / shape, self.level_weight
        kev = ((1 - weight) * left + weight * of_level) / self.adc_per_kev
        return np.where(width <= self.widest_adc, kev - self.fit.level_kev, np.nan)

    def describe(self) -> TailsInfo:
        """Summary: the rate, its error, and fractions of traces above several thresholds."""
        with_level = self.kev[np.isfinite(self.kev)]
        law, surely = self.fit.law, self.law is not None
        of_law = law.share_above(SHARES_KEV) if surely else np.zeros(len(SHARES_KEV))
        return TailsInfo(
            rate_khz=law.rate_khz if surely else 0.0,
            rate_error_khz=self.fit.rate_error_khz,
            decay_us=self.decay_us,
            decay_error_us=self.decay_error_us,
            error_kev=self.fit.sigma_kev,
            told_by="level and slope" if self.level_weight else "slope",
            energies="recorded" if self.fit.recorded else "learned from the tails",
            traces=len(with_level),
            percent_above={
                f"{kev:g}_kev": {
                    "measured": round(100 * float((with_level > kev).mean()), 2),
                    "law": round(100 * float(share), 2),
                }
                for kev, share in zip(SHARES_KEV, of_law, strict=True)
            },
        )


def _read(
    values: FloatArray, dt_ns: float, decay_us: float
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_], float]:
    """Mean of each baseline, tail, whether it holds no other pulse, and largest RMS."""
    mean, left, width = read_baselines(values, dt_ns, decay_us)
    finite = width[np.isfinite(width)]  # those of all traces that can be prepared
    centre = float(np.median(finite))
    sigma = float(median_abs_deviation(finite, scale="normal"))
    widest = centre + max(DISTURBED * sigma, 0.1 * centre)
    return mean, left, width <= widest, widest
