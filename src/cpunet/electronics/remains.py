r"""Tails of earlier pulses under raw traces, from the level and slope of their baselines.

A tail of height :math:`A` above the level of an empty baseline follows
:math:`A e^{-t/\tau}`. It raises the baseline and tilts it. With a DC-coupled amplifier the
*level* is the more precise measure, since levels vary little between traces. Level and slope
are weighted by their errors. These come from the lower side of each distribution, which the
tails do not affect. Large tails also give the decay time: the means of the two halves of
their baselines, a time :math:`h` apart, have a ratio of :math:`e^{h/\tau}`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import (
    MIN_N,
    SHORTEST_SHARE,
    SIGMA_PER_MAD,
    samples_before_pulses,
)
from cpunet.electronics.exponentials import FloatArray
from cpunet.electronics.remains_fit import RateFit, fit_rate
from cpunet.electronics.remains_law import RemainsLaw
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Prepared, prepare
from cpunet.recipes.schema import PreparationConfig

MIN_SAMPLES = 64  # minimum length of a baseline
MOST = 16384  # traces used in the fit of the law
# Remainders used for the decay time: minimum height in errors, and minimum number of traces.
LARGE, MIN_LARGE = 12.0, 20
# A baseline whose level differs by more than this factor from what its tilt implies is not
# that of a remainder.
COUPLED = 2.5
LEVEL_TELLS = 0.2  # weight of the level above which it identifies empty baselines
# Number of Gaussian standard deviations of the residual RMS beyond which a baseline holds
# another pulse.
DISTURBED = 6.0
# The rate is significant if it is SURE errors large and the log-likelihood gain is SURE_GAIN.
SURE, SURE_GAIN = 4.0, 12.0
MAX_FULL = 0.97  # maximum fraction of traces with a remainder larger than the error
MIN_EXPECTED = 1e-3  # pulses per decay time, below which the rate counts as zero
SHARES_KEV = (10.0, 30.0, 100.0, 300.0)  # thresholds at which fractions are reported


@dataclass(frozen=True, eq=False)
class Remains:
    """Remainders measured under the traces of a channel, and their law.

    Parameters
    ----------
    kev
        Remainder at the first sample of each measured trace in keV. NaN where it cannot be
        determined.
    error_kev
        Standard deviation of the remainders in keV.
    coupled
        Whether the levels are used in addition to the slopes.
    level_weight
        Weight of the remainder from the level. That of the slope is the complement.
    level_error_kev
        Standard deviation of the remainder from the level alone, in keV.
    decay_us, decay_error_us
        Decay time of the remainders and its error in us. The error is None if the decay time
        is that of the pulses' tails.
    baseline_adc, adc_per_kev
        Level of an empty baseline in ADC counts, and gain in ADC counts per keV.
    widest_adc
        Maximum RMS, about its remainder, of a baseline without another pulse.
    fit
        Fit of the law.
    samples
        Number of samples used of each baseline.
    dt_ns
        Sampling period in ns.
    """

    kev: FloatArray
    error_kev: float
    coupled: bool
    level_weight: float
    level_error_kev: float
    decay_us: float
    decay_error_us: float | None
    baseline_adc: float
    adc_per_kev: float
    widest_adc: float
    fit: RateFit
    samples: int
    dt_ns: float

    def empty(self, raw: Pulses) -> npt.NDArray[np.bool_]:
        """Select traces about as low as an empty baseline; all if levels are imprecise.

        No condition is placed on the slopes, so that noise alone determines them.
        """
        if not self.coupled or self.level_weight < LEVEL_TELLS:
            return np.ones(len(raw), bool)
        level = raw.waveforms[:, : self.samples].mean(axis=1)
        shape = _shape(self.samples, self.dt_ns, self.decay_us).mean()
        highest = self.baseline_adc + self.level_error_kev * self.adc_per_kev * shape
        return np.asarray(level < highest)

    @property
    def law(self) -> RemainsLaw | None:
        """The law, or None if the remainders are not significant."""
        sure = self.fit.law.rate_khz > SURE * self.fit.rate_error_khz
        return self.fit.law if sure and self.fit.gain_of_law > SURE_GAIN else None

    @classmethod
    def of_traces(
        cls,
        blocks: Iterable[Pulses],
        config: PreparationConfig,
        decay_us: float | None = None,
        most: int = MOST,
    ) -> Remains:
        """Measure the remainders under raw traces and fit their law.

        Parameters
        ----------
        blocks
            Measured traces of one channel with their energies, from any mixture of peaks.
        config
            Preparation settings.
        decay_us
            Decay time of the preamplifier in us, if known. Otherwise it is taken from large
            remainders or, if there are none, from the tails of the pulses.
        most
            Maximum number of traces to use.

        Raises
        ------
        CpunetError
            If the baselines are too short, the energies are unknown, or too few traces can
            be used.
        """
        seen = _gathered(blocks, config, most)
        decay = decay_us or seen.tail_decay_us
        mean, left, width = read_baselines(seen.baselines, seen.dt_ns, decay)
        widest = _widest(width)
        quiet = width <= widest
        level = _mode(mean[quiet])
        tilted = left > LARGE * _lower_spread(left[quiet], 0.0)
        large = seen.baselines[quiet & tilted] - level
        coupled = _lifted(large, left[quiet & tilted])
        own = _own_decay_us(large, seen.dt_ns) if coupled else None
        error: float | None = None
        if own is not None and decay_us is None:
            decay, error = own
            mean, left, width = read_baselines(seen.baselines, seen.dt_ns, decay)
            widest = _widest(width)
            quiet = width <= widest
        height = _shape(seen.baselines.shape[1], seen.dt_ns, decay).mean() * seen.adc_per_kev
        of_slope, of_level = left / seen.adc_per_kev, (mean - level) / height
        slope_error = _lower_spread(of_slope[quiet], 0.0)
        level_error = _lower_spread(of_level[quiet], 0.0) if coupled else np.inf
        weight = slope_error**2 / (slope_error**2 + level_error**2) if coupled else 0.0
        kev = (1 - weight) * of_slope + weight * of_level
        guess = (slope_error**-2.0 + level_error**-2.0) ** -0.5
        fit = fit_rate(kev[quiet], guess, decay, seen.energy_kev)
        _require_empty(fit)
        return cls(
            kev=np.where(quiet, kev - fit.level_kev, np.nan),
            error_kev=fit.sigma_kev,
            coupled=coupled,
            level_weight=weight,
            level_error_kev=level_error,
            decay_us=decay,
            decay_error_us=error,
            baseline_adc=level + (fit.level_kev / weight * height if coupled else 0.0),
            adc_per_kev=seen.adc_per_kev,
            widest_adc=widest,
            fit=fit,
            samples=seen.baselines.shape[1],
            dt_ns=seen.dt_ns,
        )

    def measure(self, raw: Pulses) -> FloatArray:
        r"""Remainder at the first sample of raw traces in keV; NaN where undetermined.

        It is the weighted mean of the remainders from slope and level,

        .. math:: A = (1 - w)\, A_{\mathrm{slope}} + w\, \frac{\bar{b} - b_0}{\bar{e}},

        with the mean :math:`\bar{b}` of the baseline, the level :math:`b_0` of an empty one and
        the mean :math:`\bar{e}` of :math:`e^{-t/\tau}` over the baseline.
        """
        baselines = np.asarray(raw.waveforms[:, : self.samples], float)
        mean, left, width = read_baselines(baselines, self.dt_ns, self.decay_us)
        kev = (1 - self.level_weight) * left / self.adc_per_kev
        if self.coupled:
            shape = _shape(self.samples, self.dt_ns, self.decay_us)
            height = shape.mean() * self.adc_per_kev
            kev += self.level_weight * (mean - self.baseline_adc) / height
        else:
            kev -= self.fit.level_kev
        return np.where(width <= self.widest_adc, kev, np.nan)

    def describe(self) -> dict[str, Any]:
        """Summary: the rate, its error, and fractions of traces above several thresholds.

        The measured fractions include the effect of the measurement error. Those of the law
        do not.
        """
        told = self.kev[np.isfinite(self.kev)]
        law, surely = self.fit.law, self.law is not None
        of_law = law.share_above(SHARES_KEV) if surely else np.zeros(len(SHARES_KEV))
        return {
            "rate_khz": law.rate_khz if surely else 0.0,
            "rate_error_khz": self.fit.rate_error_khz,
            "decay_us": self.decay_us,
            "decay_error_us": self.decay_error_us,
            "error_kev": self.error_kev,
            "told_by": "level and slope" if self.coupled else "slope",
            "energies": "recorded" if self.fit.recorded else "learned from the remains",
            "traces": len(told),
            "not_told": len(self.kev) - len(told),
            "percent_above": {
                f"{kev:g}_kev": {
                    "measured": round(100 * float((told > kev).mean()), 2),
                    "law": round(100 * float(share), 2),
                }
                for kev, share in zip(SHARES_KEV, of_law, strict=True)
            },
        }

    def subtracted_from(self, raw: Pulses) -> Pulses:
        """Traces with their remainders subtracted; unchanged where these are undetermined."""
        decay = _shape(raw.length, self.dt_ns, self.decay_us)
        heights = np.nan_to_num(self.measure(raw)) * self.adc_per_kev
        less = np.asarray(raw.waveforms - heights[:, np.newaxis] * decay, np.float32)
        return raw.with_waveforms(less)


@dataclass(frozen=True, eq=False)
class _Gathered:
    """What is kept of the traces: their first samples and scalar properties."""

    baselines: FloatArray
    energy_kev: FloatArray
    adc_per_kev: float
    tail_decay_us: float
    dt_ns: float


def _gathered(blocks: Iterable[Pulses], config: PreparationConfig, most: int) -> _Gathered:
    """Read blocks until there are enough traces."""
    baselines: list[npt.NDArray[np.float32]] = []
    energies, heights, scales, slopes = [], [], [], []
    samples = dt_ns = 0.0
    for raw in blocks:
        prepared = prepare(raw, config, "measured")
        samples = samples or _length(raw, prepared, config)
        dt_ns = raw.dt_ns
        baselines.append(np.array(raw.waveforms[:, : int(samples)]))
        energies.append(raw.energy_kev)
        height = prepared.pulses.waveforms.max(axis=1) * prepared.scale
        heights.append(height / prepared.pulses.energy_kev)
        scales.append(prepared.scale)
        slopes.append(prepared.tail_slope)
        if sum(map(len, baselines)) >= most:
            break
    if not baselines:
        raise CpunetError("there are no traces to tell remains of earlier pulses from")
    scale, slope = np.concatenate(scales), np.concatenate(slopes)
    return _Gathered(
        np.concatenate(baselines).astype(float),
        np.concatenate(energies),
        _gain(np.concatenate(heights)),
        _tail_decay_us(slope[scale >= np.median(scale)]),
        float(dt_ns),
    )


def _require_empty(fit: RateFit) -> None:
    """Raise a `CpunetError` if no baseline is empty, so that there is no reference level."""
    # no curvature despite a rate: the fit did not find the level of empty baselines
    blind = fit.law.expected > MIN_EXPECTED and not fit.rate_error_khz > 0
    if blind or float(fit.law.share_above(fit.sigma_kev)) > MAX_FULL:
        raise CpunetError(
            "nearly all traces lie on remains of earlier pulses, so that the level of an empty "
            "baseline is not seen and they cannot be measured; measure at a lower rate"
        )


def _length(raw: Pulses, prepared: Prepared, config: PreparationConfig) -> int:
    """Number of initial samples that precede nearly all pulses."""
    if len(prepared) < MIN_N:
        raise CpunetError(
            f"only {len(prepared)} of {len(raw)} traces can be prepared "
            f"({_reasons(prepared)}); {MIN_N} or more are needed to tell remains of earlier "
            "pulses"
        )
    free = samples_before_pulses(prepared, config)
    length = int(np.quantile(free, SHORTEST_SHARE))
    if length < MIN_SAMPLES:
        raise CpunetError(
            f"the traces have {max(length, 0)} samples before the pulse; remains of earlier "
            f"pulses need {MIN_SAMPLES} or more, so give traces with a longer baseline"
        )
    return length


def _reasons(prepared: Prepared) -> str:
    """Counts of the reasons why traces cannot be prepared."""
    told = [f"{n} {reason}" for reason, n in prepared.rejections.items()]
    return ", ".join(told) or "there are no more"


def _gain(ratios: FloatArray) -> float:
    """Gain in ADC counts per keV from the heights of the pulses."""
    known = ratios[np.isfinite(ratios) & (ratios > 0)]
    if len(known) < MIN_N:
        raise CpunetError(
            f"only {len(known)} traces have a known energy and can be prepared; {MIN_N} or "
            "more are needed to tell remains of earlier pulses in keV"
        )
    return float(np.median(known))


def _tail_decay_us(slopes: FloatArray) -> float:
    """Decay time in us of the tails of pulses."""
    slope = float(np.median(slopes))
    if not slope < 0:
        raise CpunetError(
            "the tails of the traces do not decay, so nothing is known of earlier pulses; "
            "are these measured traces?"
        )
    return -1e3 / slope


def _shape(length: int, dt_ns: float, decay_us: float) -> FloatArray:
    """Decay of a remainder that is 1 at the first sample, shape ``(length,)``."""
    return np.asarray(np.exp(-np.arange(length) * dt_ns * 1e-3 / decay_us), float)


def read_baselines(
    baselines: FloatArray, dt_ns: float, decay_us: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    r"""Mean of each baseline, the remainder from its tilt, and the residual RMS.

    The remainder is the least-squares height :math:`A` of

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
        Mean, remainder and RMS in the units of the baselines, each of shape ``(n,)``.

    Examples
    --------
    >>> tail = 100 + 7 * np.exp(-np.arange(500) * 0.016 / 50)
    >>> _, left, width = read_baselines(tail[np.newaxis], 16.0, 50.0)
    >>> round(float(left[0]), 6), bool(width[0] < 1e-9)
    (7.0, True)
    """
    shape = _shape(baselines.shape[1], dt_ns, decay_us)
    lever = shape - shape.mean()
    with np.errstate(invalid="ignore", over="ignore"):
        mean = baselines.mean(axis=1)
        left = baselines @ lever / (lever @ lever)
        width = (baselines - mean[:, np.newaxis] - left[:, np.newaxis] * lever).std(axis=1)
    return mean, left, np.where(np.isfinite(width), width, np.inf)


def _widest(width: FloatArray) -> float:
    """RMS beyond which a baseline holds another pulse."""
    finite = width[np.isfinite(width)]
    if len(finite) < MIN_N:
        raise CpunetError(f"only {len(finite)} traces have finite baselines; give more")
    centre = float(np.median(finite))
    sigma = SIGMA_PER_MAD * float(np.median(np.abs(finite - centre)))
    return centre + max(DISTURBED * sigma, 0.1 * centre)


def _mode(values: FloatArray) -> float:
    """Mode of a one-sided distribution, by repeatedly halving the shortest half."""
    ordered = np.sort(values)
    while len(ordered) > 8:
        half = len(ordered) // 2
        first = int(np.argmin(ordered[half:] - ordered[: len(ordered) - half]))
        ordered = ordered[first : first + half + 1]
        if ordered[-1] == ordered[0]:
            break
    return float(ordered.mean())


def _lower_spread(values: FloatArray, centre: float) -> float:
    """Standard deviation of the side below the centre, which remainders do not affect."""
    below = centre - values[values <= centre]
    return max(float(SIGMA_PER_MAD * np.median(below)) if len(below) else 0.0, 1e-9)


def _lifted(above: FloatArray, left: FloatArray) -> bool:
    """Whether tilted baselines are as high as their tilt implies, as with DC coupling."""
    if len(above) < MIN_LARGE:
        return False
    ratio = float(np.median(above[:, : above.shape[1] // 4].mean(axis=1) / left))
    return 1 / COUPLED < ratio < COUPLED


def _own_decay_us(above: FloatArray, dt_ns: float) -> tuple[float, float] | None:
    """Decay time from the two halves of tilted baselines, and its error, in us."""
    half = above.shape[1] // 2
    first, second = above[:, :half].mean(axis=1), above[:, half : 2 * half].mean(axis=1)
    whole = (first > 0) & (second > 0)
    fall = np.log(first[whole] / second[whole])
    middle = float(np.median(fall)) if whole.sum() >= MIN_LARGE else 0.0
    if not middle > 0:
        return None
    error = 1.2533 * SIGMA_PER_MAD * float(np.median(np.abs(fall - middle)))
    decay = half * dt_ns * 1e-3 / middle
    return decay, decay * error / middle / float(np.sqrt(len(fall)))
