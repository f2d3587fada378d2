r"""What earlier pulses leave of themselves under a trace, as a law with one number: their rate.

Pulses come at random, at a rate R, with energies E of a spectrum; each decays with a time
:math:`\tau`. One alone leaves more than x if it came at most :math:`\tau \ln(E/x)` ago, so that

.. math:: P(>x) = 1 - \exp(-R \tau \langle \max(0, \ln(E/x)) \rangle)

is the share of traces with a single remainder above x. What is left of all of them together is
shot noise (Campbell 1909), whose characteristic function has an exponent in closed form,

.. math:: \ln \varphi(u) = R \tau \left\langle \int_0^E \frac{e^{iux} - 1}{x} dx \right\rangle
    = R \tau \left\langle i\,\mathrm{Si}(uE) - \mathrm{Cin}(uE) \right\rangle .
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.special

from cpunet.electronics.exponentials import FloatArray

# After so many decay times nothing is left that noise would not hide: 0.02 keV of 2615.
LIFETIMES = 12.0
_LEAST_KEV = 1e-3
_ENERGIES = 64  # of a spectrum, in sums over it


@dataclass(frozen=True, eq=False)
class RemainsLaw:
    """The law of remains of earlier pulses.

    Parameters
    ----------
    rate_khz
        Of the pulses.
    decay_us
        Of their tails.
    energies_kev
        Quantiles of their energies, evenly spaced from the lowest to the highest; between
        them the logarithm is taken as linear.

    Examples
    --------
    >>> law = RemainsLaw(1.5, 84.6, (10, 60, 85, 155, 235, 240, 365, 560, 720, 1980, 2615))
    >>> law.share_above([10.0, 50.0]).round(2).tolist()  # of the traces
    [0.34, 0.2]
    """

    rate_khz: float
    decay_us: float
    energies_kev: tuple[float, ...]

    @property
    def expected(self) -> float:
        """Pulses within a decay time."""
        return self.rate_khz * 1e-3 * self.decay_us

    @property
    def mean_kev(self) -> float:
        """Mean of what is left, by Campbell's theorem."""
        return self.expected * float(_some(self.energies_kev).mean())

    def share_above(self, kev: npt.ArrayLike) -> FloatArray:
        """Share of traces on which one earlier pulse leaves more than `kev`."""
        ratio = _some(self.energies_kev) / np.asarray(kev, float)[..., np.newaxis]
        lives = np.log(np.maximum(ratio, 1)).mean(axis=-1)
        return np.asarray(-np.expm1(-self.expected * lives), float)

    def density(
        self, step_kev: float, n: int, sigma_kev: float
    ) -> tuple[FloatArray, FloatArray]:
        """Density of a measured remainder, of all pulses together, per keV.

        Parameters
        ----------
        step_kev, n
            Of the grid, of which the first quarter lies below 0.
        sigma_kev
            Standard deviation of the measurement, a few steps of the grid or more.

        Returns
        -------
        tuple
            Values in keV, and the density there, both of shape ``(n,)``.
        """
        u = 2 * np.pi * scipy.fft.rfftfreq(n, step_kev)
        per_pulse = characteristic_exponents(u, _some(self.energies_kev)).mean(axis=1)
        exponent = self.expected * per_pulse - 0.5 * (sigma_kev * u) ** 2
        first = n // 4
        shifted = np.exp(exponent + 1j * u * first * step_kev)
        density = scipy.fft.irfft(np.conj(shifted), n) / step_kev
        kev = np.asarray((np.arange(n) - first) * step_kev, float)
        return kev, np.asarray(np.maximum(density, 0.0), float)

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw what is left in keV, of all earlier pulses together, for `n` traces."""
        row, kev, before_us = earlier_pulses(
            n, self.rate_khz, LIFETIMES * self.decay_us, self.energies_kev, rng
        )
        left = kev * np.exp(-before_us / self.decay_us)
        return np.asarray(np.bincount(row, left, minlength=n), float)


def characteristic_exponents(
    u: FloatArray, energies_kev: FloatArray
) -> npt.NDArray[np.complex128]:
    """Logarithm of the characteristic function at `u` (1/keV), per expected pulse.

    Returns
    -------
    array
        For pulses of each energy, shape ``(len(u), len(energies_kev))``.
    """
    phase = np.maximum(u[:, np.newaxis] * energies_kev, 1e-12)
    sine, cosine = scipy.special.sici(phase)
    return np.asarray(1j * sine - (np.euler_gamma + np.log(phase) - cosine))


def earlier_pulses(
    n: int,
    rate_khz: float,
    longest_us: float,
    energies_kev: Sequence[float],
    rng: np.random.Generator,
) -> tuple[npt.NDArray[np.intp], FloatArray, FloatArray]:
    """Draw pulses by a Poisson process within a time, for each of `n` traces.

    Returns
    -------
    tuple
        Which trace each belongs to, its energy in keV, and its time in us, from 0 to
        `longest_us`; all of shape ``(pulses,)``.
    """
    counts = rng.poisson(rate_khz * 1e-3 * longest_us, size=n)
    row = np.repeat(np.arange(n), counts)
    kev = energies_at(rng.random(len(row)), energies_kev)
    return row, kev, rng.uniform(0, longest_us, size=len(row))


def energies_at(share: FloatArray, energies_kev: Sequence[float]) -> FloatArray:
    """Energies in keV below which a `share` of a spectrum lies, given its quantiles."""
    logs = np.log(np.maximum(np.asarray(energies_kev, float), _LEAST_KEV))
    at = np.linspace(0, 1, len(logs))
    return np.asarray(np.exp(np.interp(share, at, logs)), float)


def _some(energies_kev: Sequence[float]) -> FloatArray:
    """Equally likely energies that stand for the spectrum."""
    return energies_at((np.arange(_ENERGIES) + 0.5) / _ENERGIES, energies_kev)
