"""What earlier pulses have left under each raw trace, from level and slope of its baseline.

A remainder of height A over the level of an empty baseline is A exp(-t/tau): it lifts the
baseline and tilts it.  Where the amplifier is coupled through, the *level* tells it better
than the slope, since levels differ by little from trace to trace; both are weighted by their
errors, which the side of each distribution shows that remains leave alone.  Large remains
tell the decay, as the two halves of their baselines differ in height by exp(h/tau).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import (
    FEWEST,
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

LEAST_SAMPLES = 64  # of a baseline
MOST = 16384  # traces that the law is fitted to
# Remains from which the decay is taken: so many errors high, and so many traces.
LARGE, FEWEST_LARGE = 12.0, 20
# What lies higher or lower than its tilt says, by this factor, is no remainder's level.
COUPLED = 2.5
LEVEL_TELLS = 0.2  # the weight of a level that tells which baselines are empty
# Gaussian deviations of what is left of a baseline without its remainder: beyond, there is
# another pulse in it.
DISTURBED = 6.0
# The rate is known if the likelihood says so, and if it is this many times its error.
SURE, SURE_GAIN = 4.0, 12.0
MOST_FULL = 0.97  # of the traces may have remains of more than an error
LEAST_EXPECTED = 1e-3  # pulses in a decay time, below which there is no rate
SHARES_KEV = (10.0, 30.0, 100.0, 300.0)  # sizes whose shares are told


@dataclass(frozen=True, eq=False)
class Remains:
    """What tells the remains of a channel's traces, and their law.

    Parameters
    ----------
    kev
        What is left at the first sample of the traces that were measured; NaN where that
        cannot be told.
    error_kev
        Its standard deviation.
    coupled
        Whether levels count, and not slopes alone.
    level_weight
        Of the remainder that the level tells; the rest is that of the slope.
    level_error_kev
        Error of what the level tells alone.
    decay_us, decay_error_us
        Of the remains; the latter None if it is that of the pulses' tails.
    baseline_adc, adc_per_kev
        Level without any remainder, and the height of a keV.
    widest_adc
        RMS about its remainder of a baseline without another pulse, at most.
    fit
        Of the law.
    samples
        Of each baseline that were looked at.
    dt_ns
        Sampling period.
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
        """Which traces are about as low as an empty baseline; all if levels tell little.

        Nothing is asked of their slopes, so that these stay what noise makes them.
        """
        if not self.coupled or self.level_weight < LEVEL_TELLS:
            return np.ones(len(raw), bool)
        level = raw.waveforms[:, : self.samples].mean(axis=1)
        shape = _shape(self.samples, self.dt_ns, self.decay_us).mean()
        highest = self.baseline_adc + self.level_error_kev * self.adc_per_kev * shape
        return np.asarray(level < highest)

    @property
    def law(self) -> RemainsLaw | None:
        """The law, if the traces surely have remains."""
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
        """Measure the remains under raw traces, and fit their law.

        Parameters
        ----------
        blocks
            Measured traces of one channel with their energies, any mixture of peaks.
        config
            How they are prepared.
        decay_us
            Of the preamplifier, if it is known; else large remains tell it, or, if there are
            none, the tails of the pulses.
        most
            Traces that are looked at.

        Raises
        ------
        CpunetError
            If baselines are too short, energies are not known, or too few traces can be used.
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
        """What is left at the first sample of raw traces in keV, NaN where that is not told."""
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
        """What is told of them: the law's number, its error, and shares by size.

        The shares of the traces measured hold what the error makes; those of the law do not.
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
        """The traces without their remains; those whose remainder is not known stay."""
        decay = _shape(raw.length, self.dt_ns, self.decay_us)
        heights = np.nan_to_num(self.measure(raw)) * self.adc_per_kev
        less = np.asarray(raw.waveforms - heights[:, np.newaxis] * decay, np.float32)
        return raw.with_waveforms(less)


@dataclass(frozen=True, eq=False)
class _Gathered:
    """What is kept of traces: their first samples and numbers."""

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
    """Raise a `CpunetError` if there is no empty baseline to tell anything from."""
    # no curvature where there is a rate: the fit has not found the level of empty baselines
    blind = fit.law.expected > LEAST_EXPECTED and not fit.rate_error_khz > 0
    if blind or float(fit.law.share_above(fit.sigma_kev)) > MOST_FULL:
        raise CpunetError(
            "nearly all traces lie on remains of earlier pulses, so that the level of an empty "
            "baseline is not seen and nothing is told of them; measure at a lower rate"
        )


def _length(raw: Pulses, prepared: Prepared, config: PreparationConfig) -> int:
    """How many first samples precede nearly all pulses."""
    if len(prepared) < FEWEST:
        raise CpunetError(
            f"only {len(prepared)} of {len(raw)} traces can be prepared "
            f"({_reasons(prepared)}); {FEWEST} or more are needed to tell remains of earlier "
            "pulses"
        )
    free = samples_before_pulses(prepared, config)
    length = int(np.quantile(free, SHORTEST_SHARE))
    if length < LEAST_SAMPLES:
        raise CpunetError(
            f"the traces have {max(length, 0)} samples before the pulse; remains of earlier "
            f"pulses need {LEAST_SAMPLES} or more, so give traces with a longer baseline"
        )
    return length


def _reasons(prepared: Prepared) -> str:
    """Why traces cannot be prepared; by reason."""
    told = [f"{n} {reason}" for reason, n in prepared.rejections.items()]
    return ", ".join(told) or "there are no more"


def _gain(ratios: FloatArray) -> float:
    """ADC counts per keV of the pulses' heights."""
    known = ratios[np.isfinite(ratios) & (ratios > 0)]
    if len(known) < FEWEST:
        raise CpunetError(
            f"only {len(known)} traces have a known energy and can be prepared; {FEWEST} or "
            "more are needed to tell remains of earlier pulses in keV"
        )
    return float(np.median(known))


def _tail_decay_us(slopes: FloatArray) -> float:
    """Of the tails of pulses."""
    slope = float(np.median(slopes))
    if not slope < 0:
        raise CpunetError(
            "the tails of the traces do not decay, so nothing of earlier pulses can be told; "
            "are these measured traces?"
        )
    return -1e3 / slope


def _shape(length: int, dt_ns: float, decay_us: float) -> FloatArray:
    """What a remainder of 1 at the first sample becomes, shape ``(length,)``."""
    return np.asarray(np.exp(-np.arange(length) * dt_ns * 1e-3 / decay_us), float)


def read_baselines(
    baselines: FloatArray, dt_ns: float, decay_us: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean of each baseline, the remainder that its tilt shows, and the RMS about it."""
    shape = _shape(baselines.shape[1], dt_ns, decay_us)
    lever = shape - shape.mean()
    with np.errstate(invalid="ignore", over="ignore"):
        mean = baselines.mean(axis=1)
        left = baselines @ lever / (lever @ lever)
        width = (baselines - mean[:, np.newaxis] - left[:, np.newaxis] * lever).std(axis=1)
    return mean, left, np.where(np.isfinite(width), width, np.inf)


def _widest(width: FloatArray) -> float:
    """The RMS beyond which there is another pulse in a baseline."""
    finite = width[np.isfinite(width)]
    if len(finite) < FEWEST:
        raise CpunetError(f"only {len(finite)} traces have finite baselines; give more")
    centre = float(np.median(finite))
    sigma = SIGMA_PER_MAD * float(np.median(np.abs(finite - centre)))
    return centre + max(DISTURBED * sigma, 0.1 * centre)


def _mode(values: FloatArray) -> float:
    """The densest place of a one-sided distribution: by halving its shortest half."""
    ordered = np.sort(values)
    while len(ordered) > 8:
        half = len(ordered) // 2
        first = int(np.argmin(ordered[half:] - ordered[: len(ordered) - half]))
        ordered = ordered[first : first + half + 1]
        if ordered[-1] == ordered[0]:
            break
    return float(ordered.mean())


def _lower_spread(values: FloatArray, centre: float) -> float:
    """Standard deviation of the side below the centre, which remains leave alone."""
    below = centre - values[values <= centre]
    return max(float(SIGMA_PER_MAD * np.median(below)) if len(below) else 0.0, 1e-9)


def _lifted(above: FloatArray, left: FloatArray) -> bool:
    """Whether tilted baselines lie as high as their tilt says: what decays is there."""
    if len(above) < FEWEST_LARGE:
        return False
    ratio = float(np.median(above[:, : above.shape[1] // 4].mean(axis=1) / left))
    return 1 / COUPLED < ratio < COUPLED


def _own_decay_us(above: FloatArray, dt_ns: float) -> tuple[float, float] | None:
    """The decay that the halves of tilted baselines show, and its error."""
    half = above.shape[1] // 2
    first, second = above[:, :half].mean(axis=1), above[:, half : 2 * half].mean(axis=1)
    whole = (first > 0) & (second > 0)
    fall = np.log(first[whole] / second[whole])
    middle = float(np.median(fall)) if whole.sum() >= FEWEST_LARGE else 0.0
    if not middle > 0:
        return None
    error = 1.2533 * SIGMA_PER_MAD * float(np.median(np.abs(fall - middle)))
    decay = half * dt_ns * 1e-3 / middle
    return decay, decay * error / middle / float(np.sqrt(len(fall)))
