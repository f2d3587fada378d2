r"""Distribution of the tails that earlier pulses leave under a trace, and fit of their rate.

Pulses arrive at random with a rate :math:`R` and energies :math:`E` from a spectrum. Each
decays with a time constant :math:`\tau`. A single pulse leaves more than :math:`x` if it
arrived at most :math:`\tau \ln(E/x)` ago. Therefore

.. math:: P(>x) = 1 - \exp(-R \tau \langle \max(0, \ln(E/x)) \rangle)

is the fraction of traces with at least one tail above :math:`x`. The sum of all
tails is shot noise (Campbell 1909). The logarithm of its characteristic function is

.. math:: \ln \varphi(u) = R \tau \left\langle \int_0^E \frac{e^{iux} - 1}{x} dx \right\rangle
    = R \tau \left\langle i\,\mathrm{Si}(uE) - \mathrm{Cin}(uE) \right\rangle .

A tail is described by its height at the first sample of a trace, in keV. The only free
parameter of the law is the rate.

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
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cpunet.electronics.exponentials import FloatArray
from cpunet.errors import CpunetError

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

# After this many decay times the tail is below the noise: 0.02 keV of 2615 keV.
LIFETIMES = 12.0
MAX_EXPECTED = 10_000.0  # maximum expected number of pulses before a trace, for memory
_MIN_KEV = 1e-3
_ENERGIES = 64  # energies that represent a spectrum in sums over it


@dataclass(frozen=True, eq=False)
class TailsLaw:
    """The law of pile-up tails.

    Parameters
    ----------
    rate_khz
        Rate of the pulses in kHz.
    decay_us
        Decay time of their tails in us.
    energies_kev
        Quantiles of their energies in keV, evenly spaced in probability from the minimum to
        the maximum. The logarithm is interpolated linearly between them.

    Examples
    --------
    >>> law = TailsLaw(1.5, 84.6, (10, 60, 85, 155, 235, 240, 365, 560, 720, 1980, 2615))
    >>> law.share_above([10.0, 50.0]).round(2).tolist()  # of the traces
    [0.34, 0.2]
    """

    rate_khz: float
    decay_us: float
    energies_kev: tuple[float, ...]

    @property
    def expected(self) -> float:
        r"""Expected number of pulses per decay time, :math:`R \tau`."""
        return self.rate_khz * 1e-3 * self.decay_us

    def share_above(self, kev: npt.ArrayLike) -> FloatArray:
        r"""Fraction of traces on which a single earlier pulse leaves more than `kev`.

        .. math:: P(>x) = 1 - \exp(-R \tau \langle \max(0, \ln(E/x)) \rangle)

        Examples
        --------
        With a single energy, :math:`x = E/e` lies one decay time back.

        >>> law = TailsLaw(1.0, 100.0, (300.0, 300.0))
        >>> bool(abs(law.share_above(300.0 / np.e) - (1 - np.exp(-0.1))) < 1e-12)
        True
        """
        # of equally probable energies that represent the spectrum
        energies = energies_at((np.arange(_ENERGIES) + 0.5) / _ENERGIES, self.energies_kev)
        ratio = energies / np.asarray(kev, float)[..., np.newaxis]
        lives = np.log(np.maximum(ratio, 1)).mean(axis=-1)
        return np.asarray(-np.expm1(-self.expected * lives), float)

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw the tail in keV, summed over all earlier pulses, for `n` traces."""
        row, kev, before_us = earlier_pulses(
            n, self.rate_khz, LIFETIMES * self.decay_us, self.energies_kev, rng
        )
        left = kev * np.exp(-before_us / self.decay_us)
        return np.asarray(np.bincount(row, left, minlength=n), float)


def characteristic_exponents(
    u: FloatArray, energies_kev: FloatArray
) -> npt.NDArray[np.complex128]:
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
    import scipy.special  # a fifth of a second, for those who look for tails only

    phase = np.maximum(u[:, np.newaxis] * energies_kev, 1e-12)
    sine, cosine = scipy.special.sici(phase)
    return np.asarray(1j * sine - (np.euler_gamma + np.log(phase) - cosine))


def earlier_pulses(
    n: int,
    rate_khz: float,
    longest_us: float,
    energies_kev: Sequence[float],
    rng: np.random.Generator,
    *,
    most: float = MAX_EXPECTED,
) -> tuple[npt.NDArray[np.intp], FloatArray, FloatArray]:
    """Draw pulses of a Poisson process within a time interval, for each of `n` traces.

    Parameters
    ----------
    n
        Number of traces.
    rate_khz, longest_us
        Rate in kHz and length of the interval in us.
    energies_kev
        Quantiles of the energies in keV, see `TailsLaw`.
    rng
        Random generator.
    most
        Largest number that may be expected for a trace.

    Returns
    -------
    tuple
        Index of the trace, energy in keV and time in us (0 to `longest_us`) of each pulse,
        all of shape ``(pulses,)``.

    Raises
    ------
    CpunetError
        If more pulses are expected for a trace.
    """
    expected = rate_khz * 1e-3 * longest_us
    if expected > most:
        raise CpunetError(
            f"other pulses at {rate_khz:g} kHz: {expected:.3g} in {longest_us:.3g} us, more "
            f"than {most:g}; give a lower rate, or a shorter decay or record"
        )
    counts = rng.poisson(expected, size=n)
    row = np.repeat(np.arange(n), counts)
    kev = energies_at(rng.random(len(row)), energies_kev)
    return row, kev, rng.uniform(0, longest_us, size=len(row))


def energies_at(share: FloatArray, energies_kev: Sequence[float]) -> FloatArray:
    """Energies in keV below which a fraction `share` of a spectrum lies.

    The spectrum is given by its quantiles, see `TailsLaw`.
    """
    logs = np.log(np.maximum(np.asarray(energies_kev, float), _MIN_KEV))
    at = np.linspace(0, 1, len(logs))
    return np.asarray(np.exp(np.interp(share, at, logs)), float)


Function = Callable[[FloatArray], float]

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


@dataclass(frozen=True, eq=False)
class RateFit:
    """Result of a fit of the law to a set of tails.

    Parameters
    ----------
    law, rate_error_khz
        The law, and the standard error of its rate in kHz.
    level_kev, sigma_kev
        Level of an empty baseline and spread of traces about it, in keV.
    recorded
        Whether the law uses the energies of the file rather than a fitted spectrum.
    gain_of_law
        Log-likelihood relative to that without any tails.
    """

    law: TailsLaw
    rate_error_khz: float
    level_kev: float
    sigma_kev: float
    recorded: bool
    gain_of_law: float


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
    likelihood = _Likelihood(kev, sigma_kev, np.geomspace(LOWEST_KEV, highest, NODES))
    fixed = None
    vector, gain = likelihood.best()
    if len(finite):
        own = np.histogram(np.log(finite), _edges(likelihood.energies))[0] / len(finite)
        recorded, of_recorded = likelihood.best(own)
        if gain <= of_recorded + WORTH:
            fixed, vector, gain = own, recorded, of_recorded
    curvature = _curvature(lambda v: -likelihood.value(v, fixed), vector, likelihood.sigma)
    variance = float(np.linalg.pinv(curvature, hermitian=True)[0, 0])
    expected = float(np.exp(vector[0]))
    error = expected * float(np.sqrt(max(variance, 0.0)))
    energies = _quantiles(likelihood.energies, likelihood.weights(vector, fixed))
    return RateFit(
        law=TailsLaw(1e3 * expected / decay_us, decay_us, energies),
        rate_error_khz=1e3 * error / decay_us,
        level_kev=float(vector[1]),
        sigma_kev=float(np.exp(vector[2])),
        recorded=fixed is not None,
        gain_of_law=gain - likelihood.without(),
    )


class _Likelihood:
    """Likelihood of the tails as a function of rate, level, error and spectrum."""

    def __init__(self, kev: FloatArray, sigma_kev: float, energies: FloatArray) -> None:
        self.kev, self.sigma, self.energies = kev, sigma_kev, energies
        self.step = sigma_kev / STEPS_OF_SIGMA
        # number of grid points for tails and their noise; the first quarter is below 0
        above = max(2 * float(energies[-1]), float(kev.max())) + ROOM * sigma_kev
        below = max(0.0, -float(kev.min())) + ROOM * sigma_kev
        points = max(4 * above / 3, 4 * below) / self.step
        self.points = int(np.clip(2 ** np.ceil(np.log2(points)), LEAST_GRID, MOST_GRID))
        self.u = np.asarray(2 * np.pi * np.fft.rfftfreq(self.points, self.step), float)
        exponents = np.conj(characteristic_exponents(self.u, energies)).T
        self.exponents = np.ascontiguousarray(exponents).view(np.float64)  # (energies, 2 of u)
        self.first = self.points // 4
        self.grid = (np.arange(self.points) - self.first) * self.step
        self.wings, self.widths = _wings(kev, sigma_kev)
        self.floor = OUTLIERS / max(float(np.ptp(kev)), self.step)

    def __call__(
        self, expected: float, level: float, sigma: float, weights: FloatArray
    ) -> float:
        # beyond this the noise term is negligible; shorter arrays are also allocated faster
        u = self.u[: np.searchsorted(self.u, NEGLIGIBLE / sigma)]
        parts = weights @ self.exponents[:, : 2 * len(u)]
        parts *= expected
        squares = -0.5 * (sigma * u) ** 2
        parts[::2] += squares
        parts[1::2] -= u * (level + self.first * self.step)
        spectrum = parts.view(np.complex128)
        np.exp(spectrum, out=spectrum)
        if self.wings:
            wide = np.exp((self.widths**2 - 1) * squares)
            spectrum *= 1 - self.wings + self.wings * wide
        density = np.fft.irfft(spectrum, self.points)
        density /= self.step
        np.maximum(density, 0.0, out=density)
        at = np.interp(self.kev, self.grid, density, left=0.0, right=0.0)
        return float(np.log((1 - OUTLIERS) * at + self.floor).sum())

    def value(self, vector: FloatArray, fixed: FloatArray | None) -> float:
        """Log-likelihood, with priors, at a vector of logarithms and the level."""
        prior = 0.0
        if fixed is None:
            for value, (centre, width) in zip(vector[3:], (MEDIAN, WIDTH), strict=True):
                prior -= 0.5 * ((value - centre) / width) ** 2
        expected, sigma = np.exp(np.clip(vector[[0, 2]], -20.0, 6.0))
        weights = self.weights(vector, fixed)
        return self(float(expected), float(vector[1]), float(sigma), weights) + prior

    def weights(self, vector: FloatArray, fixed: FloatArray | None) -> FloatArray:
        """Weights of the energies: fixed ones, or those of a log-normal spectrum."""
        if fixed is not None:
            return fixed
        width = np.exp(np.clip(vector[4], -2.0, 2.0))
        logs = -0.5 * ((np.log(self.energies) - vector[3]) / width) ** 2
        weights = np.exp(logs - logs.max())
        return np.asarray(weights / weights.sum(), float)

    def best(self, fixed: FloatArray | None = None) -> tuple[FloatArray, float]:
        """Vector and log-likelihood of the best fit, with fixed weights or a spectrum."""
        rest = [0.0, np.log(self.sigma)]
        if fixed is None:
            rest += [MEDIAN[0], WIDTH[0]]
        starts = ((start, *rest) for start in np.log([0.005, 0.1]))
        fits = [_minimum(lambda v: -self.value(v, fixed), start) for start in starts]
        best = min(fits, key=lambda fit: float(fit.fun))
        return np.asarray(best.x, float), -float(best.fun)

    def without(self) -> float:
        """Maximum log-likelihood without any tails."""
        weights = np.zeros(len(self.energies))
        spread = max(float(self.kev.std()), self.sigma)
        starts = [(np.median(self.kev), np.log(s)) for s in (self.sigma, spread)]
        fits = [_minimum(lambda v: -self(0.0, v[0], np.exp(v[1]), weights), s) for s in starts]
        return -min(float(fit.fun) for fit in fits)


def _wings(kev: FloatArray, sigma_kev: float) -> tuple[float, float]:
    """Fraction and relative width of a second, wider Gaussian fitted to the side below 0."""
    below = kev[kev < 0]

    def cost(vector: FloatArray) -> float:
        sigma = np.exp(vector[0])
        share, width = MAX_WINGS / (1 + np.exp(-vector[1])), 1.5 + np.exp(vector[2])
        core, wide = below / sigma, below / (width * sigma)
        density = (1 - share) * np.exp(-0.5 * core**2) + share / width * np.exp(-0.5 * wide**2)
        return -float(np.log(density / sigma + 1e-30).sum())

    if len(below) < MIN_BELOW:
        return 0.0, 1.0
    alone = _minimum(lambda v: cost(np.array([v[0], -50.0, 0.0])), (np.log(sigma_kev),))
    wide_fit = _minimum(cost, (np.log(sigma_kev), -1.0, 0.0))
    if float(wide_fit.fun) > float(alone.fun) - WORTH:
        return 0.0, 1.0
    _, share, width = wide_fit.x
    return MAX_WINGS / (1 + float(np.exp(-share))), 1.5 + float(np.exp(width))


def _minimum(function: Function, start: Sequence[float]) -> OptimizeResult:
    import scipy.optimize  # costs more than all the rest, and few channels come so far

    steps = np.diag([0.5, *[0.4] * (len(start) - 1)])
    simplex = np.asarray(start, float) + np.concatenate([np.zeros((1, len(start))), steps])
    options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-2, "maxfev": 900}
    return scipy.optimize.minimize(function, start, method="Nelder-Mead", options=options)


def _curvature(function: Function, at: FloatArray, sigma_kev: float) -> FloatArray:
    """Second derivatives by finite differences."""
    steps = np.array([0.1, 0.2 * sigma_kev, 0.05, 0.1, 0.1])[: len(at)]
    moves = np.diag(steps)
    n = len(at)
    curvature = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
            corners = [function(at + a * moves[i] + b * moves[j]) for a, b in signs]
            second = corners[0] - corners[1] - corners[2] + corners[3]
            curvature[i, j] = curvature[j, i] = second / (4 * steps[i] * steps[j])
    return curvature


def _edges(energies: FloatArray) -> FloatArray:
    """Edges of bins around the logarithms of the energies; the outer bins are open."""
    logs = np.log(energies)
    inner = 0.5 * (logs[1:] + logs[:-1])
    return np.concatenate([[-np.inf], inner, [np.inf]])


def _quantiles(energies: FloatArray, weights: npt.NDArray[np.float64]) -> tuple[float, ...]:
    """Quantiles of a spectrum, evenly spaced in probability."""
    edges = _edges(energies)
    edges[[0, -1]] = np.log(energies[[0, -1]])
    share = np.concatenate([[0.0], np.cumsum(weights)]) / weights.sum()
    at = np.interp(np.linspace(0, 1, QUANTILES), share, edges)
    return tuple(float(kev) for kev in np.exp(at))
