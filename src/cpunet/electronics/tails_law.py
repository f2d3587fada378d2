r"""Distribution of the tails that earlier pulses leave under a trace.

Pulses arrive at random with a rate :math:`R` and energies :math:`E` from a spectrum. Each
decays with a time constant :math:`\tau`. A single pulse leaves more than :math:`x` if it
arrived at most :math:`\tau \ln(E/x)` ago. Therefore

.. math:: P(>x) = 1 - \exp(-R \tau \langle \max(0, \ln(E/x)) \rangle)

is the fraction of traces with at least one tail above :math:`x`. The sum of all
tails is shot noise (Campbell 1909). The logarithm of its characteristic function is

.. math:: \ln \varphi(u) = R \tau \left\langle \int_0^E \frac{e^{iux} - 1}{x} dx \right\rangle
    = R \tau \left\langle i\,\mathrm{Si}(uE) - \mathrm{Cin}(uE) \right\rangle .

A tail is told by its height at the first sample of a trace, in keV. The only free
parameter of the law is the rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

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

    @property
    def mean_kev(self) -> float:
        r"""Mean tail in keV, :math:`R \tau \langle E \rangle` (Campbell's theorem)."""
        return self.expected * float(_some(self.energies_kev).mean())

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
        ratio = _some(self.energies_kev) / np.asarray(kev, float)[..., np.newaxis]
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

    Returns
    -------
    tuple
        Index of the trace, energy in keV and time in us (0 to `longest_us`) of each pulse,
        all of shape ``(pulses,)``.

    Raises
    ------
    CpunetError
        If more than `MAX_EXPECTED` pulses are expected for a trace.
    """
    expected = rate_khz * 1e-3 * longest_us
    if expected > MAX_EXPECTED:
        raise CpunetError(
            f"other pulses at {rate_khz:g} kHz: {expected:.3g} in {longest_us:.3g} us, more "
            f"than {MAX_EXPECTED:g}; give a lower rate or a shorter decay"
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


def _some(energies_kev: Sequence[float]) -> FloatArray:
    """Equally probable energies that represent the spectrum."""
    return energies_at((np.arange(_ENERGIES) + 0.5) / _ENERGIES, energies_kev)
