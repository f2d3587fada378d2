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

import numpy as np
import numpy.typing as npt
from iminuit import Minuit

from cpunet.electronics.exponentials import FloatArray
from cpunet.errors import CpunetError

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


def tail_shape(length: int, dt_ns: float, decay_us: float, lead_us: float = 0.0) -> FloatArray:
    """Decay of a tail that is 1 a time `lead_us` before the first sample, ``(length,)``."""
    time_us = np.arange(length) * dt_ns * 1e-3 + lead_us
    return np.asarray(np.exp(-time_us / decay_us), float)


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
    logs = np.log(likelihood.energies)
    edges = np.concatenate([[-np.inf], 0.5 * (logs[1:] + logs[:-1]), [np.inf]])
    own = np.histogram(np.log(finite), edges)[0] / max(len(finite), 1)

    def weights(shape: FloatArray) -> FloatArray:
        """Those of the file, or of a log-normal spectrum."""
        if not len(shape):
            return own
        parts = np.exp(-0.5 * ((logs - shape[0]) / np.exp(shape[1])) ** 2)
        return np.asarray(parts / parts.sum(), float)

    def cost(values: FloatArray) -> float:
        expected, level, sigma = values[:3]
        prior = sum(
            0.5 * ((value - centre) / width) ** 2
            for value, (centre, width) in zip(values[3:], (MEDIAN, WIDTH), strict=False)
        )
        likely = likelihood(np.exp(expected), level, np.exp(sigma), weights(values[3:]))
        return float(prior - likely)

    start = [0.0, np.log(sigma_kev)]
    shape = [MEDIAN[0], WIDTH[0]]
    limits = [EXPECTED, None, (start[1] + SIGMA[0], start[1] + SIGMA[1])]
    starts = [[np.log(n), *start, *shape] for n in STARTS]
    fit = _best(cost, starts, [*limits, *SPECTRUM])
    if len(finite):
        of_file = _best(cost, [[np.log(n), *start] for n in STARTS], limits)
        fit = of_file if of_file.fval <= fit.fval + WORTH else fit
    fit.hesse()
    values = np.array(fit.values)
    expected = float(np.exp(values[0]))
    spread = np.log([sigma_kev, max(float(kev.std()), sigma_kev)])
    alone = [[float(np.median(kev)), sigma] for sigma in spread]
    without = _best(
        lambda v: -likelihood(0.0, v[0], np.exp(v[1]), own),
        [values[1:3].tolist(), *alone],
        limits[1:],
    )
    # quantiles of the spectrum, evenly spaced in probability
    edges[[0, -1]] = logs[[0, -1]]
    spectrum = weights(values[3:])
    share = np.concatenate([[0.0], np.cumsum(spectrum)]) / spectrum.sum()
    quantiles = np.exp(np.interp(np.linspace(0, 1, QUANTILES), share, edges))
    return RateFit(
        law=TailsLaw(1e3 * expected / decay_us, decay_us, tuple(quantiles.tolist())),
        rate_error_khz=1e3 * expected * fit.errors[0] / decay_us,
        level_kev=float(values[1]),
        sigma_kev=float(np.exp(values[2])),
        recorded=len(values) == len(start) + 1,
        gain_of_law=without.fval - fit.fval,
    )


class _Likelihood:
    """Likelihood of the tails as a function of rate, level, error and spectrum."""

    def __init__(self, kev: FloatArray, sigma_kev: float, energies: FloatArray) -> None:
        self.kev, self.energies = kev, energies
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


def _wings(kev: FloatArray, sigma_kev: float) -> tuple[float, float]:
    """Fraction and relative width of a second, wider Gaussian fitted to the side below 0."""
    below = kev[kev < 0]

    def cost(sigma: float, share: float, width: float) -> float:
        core, wide = below / sigma, below / (width * sigma)
        density = (1 - share) * np.exp(-0.5 * core**2) + share / width * np.exp(-0.5 * wide**2)
        return -float(np.log(density / sigma + 1e-30).sum())

    def in_ranges(values: FloatArray) -> tuple[float, float, float]:
        return np.exp(values[0]), MAX_WINGS / (1 + np.exp(-values[1])), 1.5 + np.exp(values[2])

    if len(below) < MIN_BELOW:
        return 0.0, 1.0
    start = float(np.log(sigma_kev))
    limits = [(start + WINGS[0], start + WINGS[1]), WINGS, WINGS]
    alone = _best(lambda v: cost(np.exp(v[0]), 0.0, 1.0), [[start]], limits[:1])
    wide = _best(lambda v: cost(*in_ranges(v)), [[start, -1.0, 0.0]], limits)
    if wide.fval > alone.fval - WORTH:
        return 0.0, 1.0
    _, share, width = in_ranges(np.array(wide.values))
    return float(share), float(width)


def _best(
    cost: Callable[[FloatArray], float],
    starts: Sequence[Sequence[float]],
    limits: Sequence[tuple[float, float] | None],
) -> Minuit:
    """The best fit from several starts, with limits of each parameter."""
    fits = []
    for start in starts:
        fit = Minuit(cost, np.array(start))
        fit.errordef = Minuit.LIKELIHOOD
        fit.errors = [0.5, *[0.4] * (len(start) - 1)]
        for place, limit in enumerate(limits):
            fit.limits[place] = limit
        fits.append(fit.simplex().migrad())
    return min(fits, key=lambda fit: fit.fval)
