r"""Law of pile-up tails, tails for translated pulses as in the data, and later pulses.

Pulses arrive at random with a rate :math:`R` and energies :math:`E` from a spectrum. Each
decays with a time constant :math:`\tau`. A single pulse leaves more than :math:`x` if it
arrived at most :math:`\tau \ln(E/x)` ago. Therefore

.. math:: P(>x) = 1 - \exp(-R \tau \langle \max(0, \ln(E/x)) \rangle)

is the fraction of traces with at least one tail above :math:`x`. A tail is described by its
height at the first sample of a trace, in keV. The only free parameter of the law is the rate.

Tails are drawn from the law of the data. Quality cuts remove traces with large tails. The
probability of passing the cuts is measured by adding tails to measured traces without any.
Translations into prepared windows are compared with data after cuts, so their tails are
drawn with this probability. Raw traces have not passed any cuts.

In-trace pile-up, pulses within the record of a trace, is drawn by a Poisson process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from cpunet.electronics.chain import FloatArray as Values
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray

# After this many decay times the tail is below the noise: 0.02 keV of 2615 keV.
LIFETIMES = 12.0
# Maximum expected numbers of pulses before a trace, for memory, and within one.
MAX_EXPECTED, MAX_PILED = 10_000.0, 4.0
_ENERGIES = 64  # energies that represent a spectrum in sums over it
# Tails in keV at which the probability of passing the cuts is measured.
SIZES_KEV = (0.0, *np.geomspace(3.0, 3000.0, 25).tolist())

Columns = dict[str, tuple[npt.NDArray[Any], str]]


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

    def share_above(self, kev: npt.ArrayLike) -> Values:
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
        expected = self.rate_khz * 1e-3 * self.decay_us
        return np.asarray(-np.expm1(-expected * lives), float)

    def draw(self, n: int, rng: np.random.Generator) -> Values:
        """Draw the tail in keV, summed over all earlier pulses, for `n` traces."""
        energies, longest_us = self.energies_kev, LIFETIMES * self.decay_us
        row, kev, before_us = earlier_pulses(n, self.rate_khz, longest_us, energies, rng)
        left = kev * np.exp(-before_us / self.decay_us)
        return np.asarray(np.bincount(row, left, minlength=n), float)


def tail_shape(length: int, dt_ns: float, decay_us: float, lead_us: float = 0.0) -> Values:
    """Decay of a tail that is 1 a time `lead_us` before the first sample, ``(length,)``."""
    time_us = np.arange(length) * dt_ns * 1e-3 + lead_us
    return np.asarray(np.exp(-time_us / decay_us), float)


def earlier_pulses(
    n: int,
    rate_khz: float,
    longest_us: float,
    energies_kev: Sequence[float],
    rng: np.random.Generator,
    *,
    most: float = MAX_EXPECTED,
) -> tuple[npt.NDArray[np.intp], Values, Values]:
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


def energies_at(share: Values, energies_kev: Sequence[float]) -> Values:
    """Energies in keV below which a fraction `share` of a spectrum lies.

    The spectrum is given by its quantiles, see `TailsLaw`.
    """
    at = np.linspace(0, 1, len(energies_kev))
    return np.asarray(np.exp(np.interp(share, at, np.log(energies_kev))), float)


@dataclass(frozen=True, eq=False)
class DrawnTails(TailsLaw):
    """Tails to be drawn and added to records.

    Parameters
    ----------
    rate_khz, decay_us, energies_kev
        The law from which they are drawn, at the start of a trace as long as the data's.
    height
        Height of a 1 keV pulse in prepared units times keV: about the maximum of a window.
    lead_us
        Delay of the start of a record relative to these traces, in us.
    dt_ns
        Sampling period in ns.
    passed
        Probability of passing the cuts of the data at `SIZES_KEV`. None if there are no cuts.
    """

    height: float
    lead_us: float
    dt_ns: float
    passed: tuple[float, ...] | None = None

    def draw_kev(self, n: int, rng: np.random.Generator) -> Values:
        """Draw the tails at the start of `n` traces, in keV."""
        kev = self.draw(n, rng)
        if self.passed is None:
            return kev
        again = np.arange(n)
        for _ in range(100):  # most traces have no tail and pass
            passes = np.interp(np.log1p(kev[again]), np.log1p(SIZES_KEV), self.passed)
            again = again[rng.random(len(again)) >= passes]
            kev[again] = self.draw(len(again), rng)
        return kev

    def decay(self, length: int, lead_us: float | None = None) -> Values:
        """Tail of 1 keV at each sample of a record, shape ``(length,)``."""
        lead_us = self.lead_us if lead_us is None else lead_us
        return tail_shape(length, self.dt_ns, self.decay_us, lead_us)

    def factors(self, energy_kev: Values, rng: np.random.Generator) -> FloatArray:
        """Draw tails for pulses of given energies, in prepared units."""
        kev = self.draw_kev(len(energy_kev), rng)
        return np.asarray(kev * self.height / energy_kev, np.float32)


@dataclass(frozen=True, eq=False)
class InTracePileUp:
    """Piled-up pulses within the records of `n` traces.

    Parameters
    ----------
    n
        Number of traces.
    row
        Trace of each piled-up pulse, shape ``(pulses,)``.
    kev
        Energies in keV, shape ``(pulses,)``.
    after_ns
        Times relative to the trace's own pulse in ns (negative: before it), shape
        ``(pulses,)``.
    partner
        Traces (0 to `n` - 1) whose pulse shapes are used, shape ``(pulses,)``.
    """

    n: int
    row: npt.NDArray[np.intp]
    kev: Values
    after_ns: Values
    partner: npt.NDArray[np.int64]

    @classmethod
    def draw(
        cls,
        n: int,
        rate_khz: float,
        energies_kev: Sequence[float],
        dt_ns: float,
        before: int,
        length: int,
        rng: np.random.Generator,
    ) -> Self:
        """Draw pulses of a Poisson process for records, with shapes of random traces.

        Parameters
        ----------
        n
            Number of traces.
        rate_khz, energies_kev
            Rate in kHz, and quantiles of the energies, see `TailsLaw`.
        dt_ns
            Sampling period in ns.
        before, length
            Samples of a record before the trace's own pulse, and all.
        rng
            Random generator.

        Raises
        ------
        CpunetError
            If more than `MAX_PILED` pulses are expected in a record.

        Examples
        --------
        1 kHz in a record of 20 us corresponds to 0.02 pulses per trace.

        >>> rng = np.random.default_rng(1)
        >>> piled = InTracePileUp.draw(10_000, 1.0, (10, 2615), 20.0, 250, 1000, rng)
        >>> 150 < len(piled.row) < 250, bool((piled.after_ns >= -5e3).all())
        (True, True)
        """
        record_us = 1e-3 * (length * dt_ns)
        row, kev, time_us = earlier_pulses(
            n, rate_khz, record_us, energies_kev, rng, most=MAX_PILED
        )
        partner = rng.integers(max(n, 1), size=len(row))
        return cls(n, row, kev, 1e3 * time_us - before * dt_ns, partner)

    def of_rows(self, rows: npt.NDArray[np.integer]) -> Self:
        """Piled-up pulses of selected traces, with the traces renumbered."""
        place, n = np.full(self.n, -1), len(rows)
        place[rows] = np.arange(n)
        inside = place[self.row] >= 0
        row, partner = place[self.row[inside]], self.partner[inside] % max(n, 1)
        return type(self)(n, row, self.kev[inside], self.after_ns[inside], partner)

    def columns(self) -> Columns:
        """What is in each trace, as columns of a table with their units.

        ``n_piled``: number of piled-up pulses; ``piled_kev``, ``piled_ns``: energy and time of
        the largest, NaN where there is none. All of shape ``(n,)``.
        """
        kev, after_ns = np.full(self.n, np.nan), np.full(self.n, np.nan)
        order = np.argsort(self.kev, kind="stable")  # the largest is written last
        kev[self.row[order]] = self.kev[order]
        after_ns[self.row[order]] = self.after_ns[order]
        n = np.bincount(self.row, minlength=self.n)
        return {"n_piled": (n, ""), "piled_kev": (kev, "keV"), "piled_ns": (after_ns, "ns")}

    def reach(self, dt_ns: float) -> int:
        """Number of samples beyond a record that `added` needs for the earliest pulse."""
        return int(np.ceil(-self.after_ns.min(initial=0.0) / dt_ns)) + 1

    def added(
        self, shapes: npt.NDArray[np.floating], energy_kev: Values, dt_ns: float, length: int
    ) -> Values:
        """Sum of the piled-up pulses at each sample, relative to the trace's own pulse.

        Parameters
        ----------
        shapes
            Record of each piled-up pulse as if it were the trace's own, in prepared units,
            shape ``(pulses, length + reach)``.
        energy_kev
            Energies of the traces' own pulses in keV, shape ``(n,)``.
        dt_ns
            Sampling period in ns.
        length
            Number of samples of a record.

        Returns
        -------
        numpy.ndarray
            In prepared units, shape ``(n, length)``.

        Examples
        --------
        The first sample of a step that comes half a period late has half its height.

        >>> one, kev, after_ns = np.array([0]), np.array([50.0]), np.array([24.0])
        >>> piled = InTracePileUp(1, one, kev, after_ns, partner=one)
        >>> step = np.array([[0.0, 1, 1, 1, 1, 1, 1]])
        >>> piled.added(step, np.array([100.0]), 16.0, 5).tolist()
        [[0.0, 0.0, 0.25, 0.5, 0.5]]
        """
        total, time, own = np.zeros((self.n, length)), np.arange(length), len(shapes.T)
        each = zip(self.row, self.kev, self.after_ns / dt_ns, shapes, strict=True)
        for row, kev, late, shape in each:
            moved = np.interp(time - late, np.arange(own), shape, left=0.0)
            total[row] += kev / energy_kev[row] * moved
        return total
