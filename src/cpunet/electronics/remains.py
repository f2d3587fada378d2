r"""Tails of earlier pulses under raw traces, from the level and slope of their baselines.

A tail of height :math:`A` above the level of an empty baseline follows
:math:`A e^{-t/\tau}`. It raises the baseline and tilts it. With a DC-coupled amplifier the
*level* is the more precise measure, since levels vary little between traces. Level and slope
are weighted by their errors. These come from the lower side of each distribution, which the
tails do not affect. Large tails also give the decay time: the means of the two halves of
their baselines, a time :math:`h` apart, have a ratio of :math:`e^{h/\tau}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_tails import (
    UsableBaselines,
    lifted,
    lower_spread,
    mode,
    own_decay_us,
    read_baselines,
    tail_shape,
    usable,
    widest,
)
from cpunet.electronics.exponentials import FloatArray
from cpunet.electronics.remains_fit import RateFit, fit_rate
from cpunet.electronics.remains_law import RemainsLaw
from cpunet.errors import CpunetError
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses

LARGE = 12.0  # minimum height in errors of remainders used for the decay time
# If a larger fraction of traces has remainders above the error, noise is measured only from
# traces with remainders below 0, at the cost of half of the noise.
MANY = 0.1
LEVEL_TELLS = 0.2  # weight of the level above which it identifies empty baselines
# The rate is significant above SURE errors, with a log-likelihood gain above SURE_GAIN.
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
        """Select traces without remains, from whose baselines noise can be measured.

        If levels are precise, these are the traces with a level close to that of an empty
        baseline. No condition is placed on the slopes, so that noise alone determines them.
        Otherwise, if many traces have remains, those with a measured remainder of 0 or less are
        selected: by symmetry, the noise on this side has the power of all noise, while remains
        are mostly on the other side. If few traces have remains, all are selected.
        """
        if not self.coupled or self.level_weight < LEVEL_TELLS:
            if float(self.fit.law.share_above(self.error_kev)) < MANY:
                return np.ones(len(raw), bool)
            return np.asarray(np.nan_to_num(self.measure(raw), nan=np.inf) <= 0)
        level = raw.waveforms[:, : self.samples].mean(axis=1)
        shape = tail_shape(self.samples, self.dt_ns, self.decay_us).mean()
        highest = self.baseline_adc + self.level_error_kev * self.adc_per_kev * shape
        return np.asarray(level < highest)

    @property
    def law(self) -> RemainsLaw | None:
        """The law, or None if the remainders are not significant."""
        sure = self.fit.law.rate_khz > SURE * self.fit.rate_error_khz
        return self.fit.law if sure and self.fit.gain_of_law > SURE_GAIN else None

    @classmethod
    def of(cls, baselines: Baselines, decay_us: float | None = None) -> Remains:
        """Measure the remainders under raw traces and fit their law.

        Parameters
        ----------
        baselines
            Baselines of measured traces of one channel, from any mixture of peaks.
        decay_us
            Decay time of the preamplifier in us, if known. Otherwise it is taken from large
            remainders or, if there are none, from the tails of the pulses.

        Raises
        ------
        CpunetError
            If the baselines are too short, the energies are unknown, or too few traces can
            be used.
        """
        seen = usable(baselines)
        decay = decay_us or seen.tail_decay_us
        mean, left, quiet, broadest = _read(seen, decay)
        level = mode(mean[quiet])
        tilted = left > LARGE * lower_spread(left[quiet])
        large = seen.values[quiet & tilted] - level
        coupled = lifted(large, left[quiet & tilted])
        own = own_decay_us(large, seen.dt_ns) if coupled else None
        error: float | None = None
        if own is not None and decay_us is None:
            decay, error = own
            mean, left, quiet, broadest = _read(seen, decay)
        samples = seen.values.shape[1]
        height = tail_shape(samples, seen.dt_ns, decay).mean() * seen.adc_per_kev
        of_slope, of_level = left / seen.adc_per_kev, (mean - level) / height
        slope_error = lower_spread(of_slope[quiet])
        level_error = lower_spread(of_level[quiet]) if coupled else np.inf
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
            widest_adc=broadest,
            fit=fit,
            samples=samples,
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
            shape = tail_shape(self.samples, self.dt_ns, self.decay_us)
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
        decay = tail_shape(raw.length, self.dt_ns, self.decay_us)
        heights = np.nan_to_num(self.measure(raw)) * self.adc_per_kev
        less = np.asarray(raw.waveforms - heights[:, np.newaxis] * decay, np.float32)
        return raw.with_waveforms(less)


def remains_in_words(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and texts for the result of `Remains.describe`."""
    if not told["rate_khz"]:
        return [("remains", "of earlier pulses: none that are certain")]
    shares = ", ".join(
        f"{share['measured']:.3g} % above {size.partition('_')[0]} keV"
        for size, share in told["percent_above"].items()
    )
    rate = f"{told['rate_khz']:.3g} ± {told['rate_error_khz']:.2g} kHz"
    by = f"told by {told['told_by']}, error {told['error_kev']:.2g} keV"
    return [
        ("remains", f"of earlier pulses: {rate}, decaying with {told['decay_us']:.3g} µs"),
        ("", f"{shares} ({by})"),
    ]


def _read(
    seen: UsableBaselines, decay_us: float
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_], float]:
    """Mean of each baseline, remainder, whether it holds no other pulse, and largest RMS."""
    mean, left, width = read_baselines(seen.values, seen.dt_ns, decay_us)
    broadest = widest(width)
    return mean, left, width <= broadest, broadest


def _require_empty(fit: RateFit) -> None:
    """Raise a `CpunetError` if no baseline is empty, so that there is no reference level."""
    # no curvature despite a rate: the fit did not find the level of empty baselines
    blind = fit.law.expected > MIN_EXPECTED and not fit.rate_error_khz > 0
    if blind or float(fit.law.share_above(fit.sigma_kev)) > MAX_FULL:
        raise CpunetError(
            "nearly all traces lie on remains of earlier pulses, so that the level of an empty "
            "baseline is not seen and they cannot be measured; measure at a lower rate"
        )
