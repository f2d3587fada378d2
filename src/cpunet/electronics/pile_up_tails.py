r"""Pile-up tails under raw traces, from the level and slope of their baselines, and their rate.

A tail of height :math:`A` above the level of an empty baseline follows
:math:`A e^{-t/\tau}`. It raises the baseline and tilts it. With a DC-coupled amplifier the
*level* is the more precise measure, since levels vary little between traces. Level and slope
are weighted by their errors. These come from the lower side of each distribution, which the
tails do not affect. Large tails also give the decay time: the means of the two halves of
their baselines, after a time :math:`h`, have a ratio of :math:`e^{h/\tau}`.

The sum of all tails is shot noise (Campbell 1909). The logarithm of its characteristic function
is, for the law of `cpunet.electronics.drawn_pile_up`,

.. math:: \ln \varphi(u) = R \tau \left\langle \int_0^E \frac{e^{iux} - 1}{x} dx \right\rangle
    = R \tau \left\langle i\,\mathrm{Si}(uE) - \mathrm{Cin}(uE) \right\rangle .

In the likelihood fit of the rate each trace contributes one measured tail with an error,
relative to the level of an empty baseline. The density of the law, convolved with the error,
is known. Rate, level and error are therefore fitted together. Real noise is not Gaussian: its
wings would be mistaken for small tails. They are determined from the side below 0, which tails
do not affect.

The energies are those of the file. Where these cannot describe the rate (for example, in a file
with a few gamma lines only), they follow a log-normal spectrum up to the maximum energy, which
is fitted to the tails.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.special
from iminuit import Minuit
from pydantic import Field
from scipy.stats import median_abs_deviation

from cpunet.electronics.baseline_noise import MIN_BASELINES
from cpunet.electronics.chain import ComplexArray, FloatArray
from cpunet.electronics.drawn_pile_up import TailsLaw, tail_shape
from cpunet.errors import CpunetError
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses, shortest
from cpunet.pulses.loading import InfoPart
from cpunet.tables import with_std

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
# Range and number of energies of a spectrum; the lowest still leaves a visible tail.
LOWEST_KEV, HIGHEST_KEV, NODES = 5.0, 2700.0, 48
QUANTILES = 41  # quantiles of the returned spectrum
# Points of the density. It is periodic, so the grid must hold all energies, also in steps of
# small errors: down to 0.15 keV.
LEAST_GRID, MOST_GRID = 1024, 131_072
STEPS_OF_SIGMA = 4.0
NEGLIGIBLE = 8.8  # standard deviations in u: exp(-8.8²/2) is 1.5e-17
ROOM = 10.0  # standard deviations of room on either side
OUTLIERS = 2e-3  # fraction of traces that the law need not explain
# Required log-likelihood gain of a fitted spectrum, which has two additional parameters.
WORTH = 5.0
# Maximum fraction of the noise in its wings, and minimum number of traces to determine them.
MAX_WINGS, MIN_BELOW = 0.5, 100
# Mean and width of the priors on the logarithms of the median energy and of the spectral width.
MEDIAN, WIDTH = (np.log(240.0), 1.0), (0.0, 0.4)
STARTS = 0.005, 0.1  # pulses per decay time at which fits begin
# Limits of logarithms: of this number, of the error over its estimate (below, the grid is too
# coarse), of the spectrum, and of the wings.
EXPECTED, SIGMA, SPECTRUM = (-20.0, 6.0), (-1.0, 8.0), ((0.0, 10.0), (-2.0, 2.0))
WINGS = -5.0, 5.0


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


def tails_kev(
    values: FloatArray, dt_ns: float, decay_us: float, level_adc: float, adc_per_kev: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tails by slope and by level in keV, and residual RMS, see `read_baselines`."""
    mean, left, width = read_baselines(values, dt_ns, decay_us)
    per_kev = tail_shape(values.shape[1], dt_ns, decay_us).mean() * adc_per_kev
    return left / adc_per_kev, (mean - level_adc) / per_kev, width


def widest_of(width: FloatArray) -> float:
    """Largest residual RMS of a baseline without another pulse, from those of many."""
    finite = width[np.isfinite(width)]  # those of all traces that can be prepared
    centre = float(np.median(finite))
    sigma = float(median_abs_deviation(finite, scale="normal"))
    return centre + max(DISTURBED * sigma, 0.1 * centre)


def mode(values: FloatArray) -> float:
    """Mode of a one-sided distribution, by repeatedly halving the shortest half."""
    ordered = np.sort(values)
    while len(ordered) > 8:
        ordered = shortest(ordered, len(ordered) // 2 + 1)
    return float(ordered.mean())


def lower_spread(values: FloatArray) -> float:
    """Standard deviation of the side below 0, which tails do not affect."""
    below = -values[values <= 0]
    return max(1.4826 * float(np.median(below)) if len(below) else 0.0, 1e-9)


@dataclass(frozen=True, eq=False)
class RateFit:
    """Result of a fit of the law to a set of tails.

    Parameters
    ----------
    law, rate_error_khz
        The law, and the standard error of its rate in kHz.
    level_kev, sigma_kev
        Level of an empty baseline and spread of traces about it, in keV.
    gain_of_law
        Log-likelihood relative to that without any tails.
    """

    law: TailsLaw
    rate_error_khz: float
    level_kev: float
    sigma_kev: float
    gain_of_law: float


class TailsInfo(InfoPart):
    """What was measured of pile-up tails, or why it is `missing`, and what to draw them from.

    The measured fractions of traces include the effect of the measurement error. Those of the
    law do not.
    """

    rate_khz: float = 0.0
    drawn: dict[str, Any] | None = None
    rate_error_khz: float = 0.0
    decay_us: float = 0.0
    error_kev: float = 0.0
    told_by: str = ""
    percent_above: dict[str, dict[str, float]] = Field(default_factory=dict)
    missing: str | None = None

    def in_words(self) -> list[tuple[str, str]]:
        """Names and texts."""
        if not self.rate_khz:
            return [("pile-up tails", "none significant")]
        above = {size.partition("_")[0]: of["law"] for size, of in self.percent_above.items()}
        shares = ", ".join(f"{share:.2g} % above {kev} keV" for kev, share in above.items())
        rate = f"{with_std(self.rate_khz, self.rate_error_khz)} kHz"
        by = f"estimated from {self.told_by}, error {self.error_kev:.2g} keV"
        rate += f", decaying with {self.decay_us:.3g} µs"
        return [("pile-up tails", rate), ("", f"{shares} ({by})")]


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
    decay_us
        Decay time of the tails in us.
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
    def of(cls, baselines: Baselines) -> PileUpTails:
        """Measure the tails under raw traces and fit their law.

        Their decay time is taken from large tails or, if there are none or levels do not follow
        them, from the tails of the pulses.

        Parameters
        ----------
        baselines
            Baselines of measured traces of one channel, from any mixture of peaks.

        Raises
        ------
        CpunetError
            If the baselines are too short, the energies are unknown, or too few traces can
            be used.
        """
        prepared, samples, dt_ns = baselines.prepared, baselines.length, baselines.first.dt_ns
        with np.errstate(divide="ignore"):  # an energy of 0 is left out
            gains = baselines.height / prepared.pulses.energy_kev
        gains = gains[np.isfinite(gains) & (gains > 0)]
        if len(gains) < MIN_BASELINES:
            reasons = "".join(f", {n} {reason}" for reason, n in prepared.rejections.items())
            raise CpunetError(
                f"only {len(gains)} of {len(baselines)} traces can be prepared and have a "
                f"known energy{reasons}; {MIN_BASELINES} or more are needed to tell pile-up "
                "tails"
            )
        if samples < MIN_SAMPLES:
            raise CpunetError(
                f"{samples} samples before pulses are too few for tails; give {MIN_SAMPLES}"
            )
        slopes = prepared.tail_slope[prepared.scale >= np.median(prepared.scale)]
        if not (slope := float(np.median(slopes))) < 0:
            raise CpunetError("the traces' tails do not decay; are these measured traces?")
        gain, decay = float(np.median(gains)), -1e3 / slope
        values = baselines.first.waveforms[:, :samples].astype(float)

        # the decay time is that of large tails, if levels follow them
        mean, left, width = read_baselines(values, dt_ns, decay)
        quiet = width <= widest_of(width)
        level = mode(mean[quiet])
        tilted = quiet & (left > LARGE * lower_spread(left[quiet]))
        large, coupled = values[tilted] - level, False
        if len(large) >= MIN_LARGE:  # with DC coupling they are as high as their tilt implies
            high = large[:, : samples // 4].mean(axis=1) / left[tilted]
            coupled = 1 / COUPLED < float(np.median(high)) < COUPLED
        if coupled:  # by their means over both halves
            half = samples // 2
            first, second = large[:, :half].mean(axis=1), large[:, half : 2 * half].mean(axis=1)
            positive = (first > 0) & (second > 0)
            fall = np.log(first[positive] / second[positive])
            if len(fall) >= MIN_LARGE and (middle := float(np.median(fall))) > 0:
                decay = half * dt_ns * 1e-3 / middle

        # tails by slope and by level, weighted by their errors
        of_slope, of_level, width = tails_kev(values, dt_ns, decay, level, gain)
        quiet = width <= (widest := widest_of(width))
        slope_error = lower_spread(of_slope[quiet])
        level_error = lower_spread(of_level[quiet]) if coupled else np.inf
        weight = slope_error**2 / (slope_error**2 + level_error**2)
        kev = (1 - weight) * of_slope + weight * of_level
        guess = (slope_error**-2.0 + level_error**-2.0) ** -0.5
        fit = fit_rate(kev[quiet], guess, decay, baselines.first.energy_kev)
        kev = np.where(quiet, kev - fit.level_kev, np.nan)
        tails = cls(kev, weight, level_error, decay, level, gain, widest, fit, samples, dt_ns)
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
        units = self.level_adc, self.adc_per_kev
        of_slope, of_level, width = tails_kev(baselines, self.dt_ns, self.decay_us, *units)
        kev = (1 - self.level_weight) * of_slope + self.level_weight * of_level
        return np.where(width <= self.widest_adc, kev - self.fit.level_kev, np.nan)

    def describe(self) -> TailsInfo:
        """Summary: the rate, its error, and fractions of traces above several thresholds."""
        law, surely = self.fit.law, self.law is not None
        measured = self.kev[np.isfinite(self.kev)]
        percent = {}
        for kev in SHARES_KEV:
            shares = (measured > kev).mean(), law.share_above(kev) if surely else 0.0
            seen, by_law = (round(100 * float(share), 2) for share in shares)
            percent[f"{kev:g}_kev"] = {"measured": seen, "law": by_law}
        return TailsInfo(
            rate_khz=law.rate_khz if surely else 0.0,
            rate_error_khz=self.fit.rate_error_khz,
            decay_us=self.decay_us,
            error_kev=self.fit.sigma_kev,
            told_by="level and slope" if self.level_weight else "slope",
            percent_above=percent,
        )


def characteristic_exponents(u: FloatArray, energies_kev: FloatArray) -> ComplexArray:
    r"""Logarithm of the characteristic function per expected pulse.

    .. math:: \int_0^E \frac{e^{iux} - 1}{x} dx = i\,\mathrm{Si}(uE) - \mathrm{Cin}(uE)

    Parameters
    ----------
    u
        Arguments in 1/keV.
    energies_kev
        Pulse energies in keV.

    Returns
    -------
    array
        Complex, shape ``(len(u), len(energies_kev))``.

    Examples
    --------
    To first order it is :math:`iuE`.

    >>> characteristic_exponents(np.array([1e-5]), np.array([100.0])).imag.round(6).tolist()
    [[0.001]]
    """
    phase = np.maximum(u[:, np.newaxis] * energies_kev, 1e-12)
    sine, cosine = scipy.special.sici(phase)
    return np.asarray(1j * sine - (np.euler_gamma + np.log(phase) - cosine))


def fit_rate(
    kev: FloatArray, sigma_kev: float, decay_us: float, energies_kev: FloatArray
) -> RateFit:
    r"""Fit rate, level and error to measured tails.

    The log-likelihood of the tails :math:`x_i` is

    .. math:: \ln L = \sum_i \ln\left[(1 - \epsilon)\, p(x_i) + \epsilon u\right],

    where :math:`p` is the density of the law convolved with the noise and :math:`u` a uniform
    density for a small fraction :math:`\epsilon` of outliers. With the characteristic function
    :math:`\varphi` of the law, and except for the wings of the noise,

    .. math:: p(x) = \frac{1}{2\pi} \int \varphi(u)\, e^{-\sigma^2 u^2 / 2}\, e^{-iux} du .

    Parameters
    ----------
    kev
        Measured tails in keV, near 0 for empty baselines.
    sigma_kev
        Initial estimate of their standard deviation in keV.
    decay_us
        Decay time of the tails in us.
    energies_kev
        Energies of the pulses of the file in keV.
    """
    finite = energies_kev[np.isfinite(energies_kev) & (energies_kev > LOWEST_KEV)]
    highest = float(np.clip(finite.max(initial=0.0), 100.0, HIGHEST_KEV))
    energies = np.geomspace(LOWEST_KEV, highest, NODES)
    likelihood, logs = _likelihood(kev, sigma_kev, energies), np.log(energies)
    edges = np.concatenate([[-np.inf], 0.5 * (logs[1:] + logs[:-1]), [np.inf]])
    own = np.histogram(np.log(finite), edges)[0] / max(len(finite), 1)

    def weights(shape: FloatArray) -> FloatArray:
        """Those of the file, or of a log-normal spectrum."""
        if not len(shape):
            return own
        parts = np.exp(-0.5 * ((logs - shape[0]) / np.exp(shape[1])) ** 2)
        return np.asarray(parts / parts.sum(), float)

    def cost(values: FloatArray) -> float:
        (expected, level, sigma), shape = values[:3], values[3:]
        priors = zip(shape, (MEDIAN, WIDTH), strict=False)
        prior = sum(0.5 * ((value - mean) / width) ** 2 for value, (mean, width) in priors)
        return float(prior - likelihood(np.exp(expected), level, np.exp(sigma), weights(shape)))

    own_sigma = float(np.log(sigma_kev))
    starts = [[np.log(n), 0.0, own_sigma] for n in STARTS]
    limits = [EXPECTED, None, (own_sigma + SIGMA[0], own_sigma + SIGMA[1])]
    fit = _best(cost, [[*s, MEDIAN[0], WIDTH[0]] for s in starts], [*limits, *SPECTRUM])
    if len(finite):
        of_file = _best(cost, starts, limits)
        fit = of_file if of_file.fval <= fit.fval + WORTH else fit
    fit.hesse()
    values = np.array(fit.values)
    khz = 1e3 * float(np.exp(values[0])) / decay_us
    spread = np.log([sigma_kev, max(float(kev.std()), sigma_kev)])
    alone = [values[1:3].tolist(), *([float(np.median(kev)), sigma] for sigma in spread)]
    # no pulses at all have a number whose logarithm is minus infinity
    without = _best(lambda v: cost(np.array([-np.inf, *v])), alone, limits[1:])
    # quantiles of the spectrum, evenly spaced in probability
    edges[[0, -1]] = logs[[0, -1]]
    spectrum = weights(values[3:])
    share = np.concatenate([[0.0], np.cumsum(spectrum)]) / spectrum.sum()
    quantiles = np.exp(np.interp(np.linspace(0, 1, QUANTILES), share, edges))
    return RateFit(
        law=TailsLaw(khz, decay_us, tuple(quantiles.tolist())),
        rate_error_khz=khz * fit.errors[0],
        level_kev=float(values[1]),
        sigma_kev=float(np.exp(values[2])),
        gain_of_law=without.fval - fit.fval,
    )


def _likelihood(
    kev: FloatArray, sigma_kev: float, energies: FloatArray
) -> Callable[[float, float, float, FloatArray], float]:
    """Log-likelihood of the tails as a function of number, level, error and spectrum."""
    step = sigma_kev / STEPS_OF_SIGMA
    # number of grid points for tails and their noise; the first quarter is below 0
    above = max(2 * float(energies[-1]), float(kev.max())) + ROOM * sigma_kev
    below = max(0.0, -float(kev.min())) + ROOM * sigma_kev
    needed = max(4 * above / 3, 4 * below) / step
    points = int(np.clip(2 ** np.ceil(np.log2(needed)), LEAST_GRID, MOST_GRID))
    arguments = np.asarray(2 * np.pi * np.fft.rfftfreq(points, step), float)
    conjugates = np.conj(characteristic_exponents(arguments, energies)).T
    exponents = np.ascontiguousarray(conjugates).view(np.float64)  # (energies, 2 of arguments)
    first = points // 4
    grid = (np.arange(points) - first) * step
    wings, widths = _wings(kev, sigma_kev)
    floor = OUTLIERS / max(float(np.ptp(kev)), step)

    def likelihood(expected: float, level: float, sigma: float, weights: FloatArray) -> float:
        # beyond this the noise term is negligible
        u = arguments[: np.searchsorted(arguments, NEGLIGIBLE / sigma)]
        exponent = (expected * (weights @ exponents[:, : 2 * len(u)])).view(np.complex128)
        squares = -0.5 * (sigma * u) ** 2
        spectrum = np.exp(exponent + squares - 1j * (u * (level + first * step)))
        if wings:
            spectrum *= 1 - wings + wings * np.exp((widths**2 - 1) * squares)
        density = np.maximum(np.fft.irfft(spectrum, points) / step, 0.0)
        at = np.interp(kev, grid, density, left=0.0, right=0.0)
        return float(np.log((1 - OUTLIERS) * at + floor).sum())

    return likelihood


def _wings(kev: FloatArray, sigma_kev: float) -> tuple[float, float]:
    """Fraction and relative width of a second, wider Gaussian fitted to the side below 0."""
    below, start = kev[kev < 0], float(np.log(sigma_kev))
    limits = [(start + WINGS[0], start + WINGS[1]), WINGS, WINGS]
    if len(below) < MIN_BELOW:
        return 0.0, 1.0

    def in_ranges(values: Sequence[float]) -> tuple[float, float, float]:
        return np.exp(values[0]), MAX_WINGS / (1 + np.exp(-values[1])), 1.5 + np.exp(values[2])

    def cost(values: Sequence[float]) -> float:
        sigma, share, width = in_ranges(values)
        core, wide = below / sigma, below / (width * sigma)
        density = (1 - share) * np.exp(-0.5 * core**2) + share / width * np.exp(-0.5 * wide**2)
        return -float(np.log(density / sigma + 1e-30).sum())

    # without wings the logarithm of their fraction is minus infinity
    alone = _best(lambda v: cost([*v, -np.inf, 0.0]), [[start]], limits[:1])
    wide = _best(cost, [[start, -1.0, 0.0]], limits)
    return in_ranges(wide.values)[1:] if wide.fval <= alone.fval - WORTH else (0.0, 1.0)


def _best(
    cost: Callable[[Any], float],
    starts: Sequence[Sequence[float]],
    limits: Sequence[tuple[float, float] | None],
) -> Minuit:
    """The best fit from several starts, with limits of each parameter."""
    fits = [Minuit(cost, np.array(start)) for start in starts]
    for fit in fits:
        fit.errordef, fit.limits = Minuit.LIKELIHOOD, limits
        fit.errors = [0.5, *[0.4] * (fit.npar - 1)]
        fit.simplex().migrad()
    return min(fits, key=lambda fit: fit.fval)
