"""In-trace pile-up: pulses within the record of a trace, drawn by a Poisson process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from cpunet.electronics.exponentials import FloatArray
from cpunet.electronics.tails_law import earlier_pulses
from cpunet.errors import CpunetError

MAX_EXPECTED = 4.0  # maximum expected number of piled-up pulses per trace

Columns = dict[str, tuple[npt.NDArray[np.generic], str]]


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
    kev: FloatArray
    after_ns: FloatArray
    partner: npt.NDArray[np.int64]

    def of_rows(self, rows: npt.NDArray[np.integer]) -> Self:
        """Piled-up pulses of selected traces, with the traces renumbered."""
        place = np.full(self.n, -1)
        place[rows] = np.arange(len(rows))
        kept = place[self.row] >= 0
        return type(self)(
            len(rows),
            place[self.row[kept]],
            self.kev[kept],
            self.after_ns[kept],
            self.partner[kept] % max(len(rows), 1),
        )

    def largest(self) -> tuple[npt.NDArray[np.int64], FloatArray, FloatArray]:
        """Number of piled-up pulses in each trace, and energy and time of the largest.

        Energies (keV) and times (ns) are NaN where there is none. All of shape ``(n,)``.
        """
        kev, after_ns = np.full(self.n, np.nan), np.full(self.n, np.nan)
        order = np.argsort(self.kev, kind="stable")  # the largest is written last
        kev[self.row[order]] = self.kev[order]
        after_ns[self.row[order]] = self.after_ns[order]
        return np.bincount(self.row, minlength=self.n), kev, after_ns

    def columns(self) -> Columns:
        """Results of `largest` as columns of a table, with their units."""
        count, kev, after_ns = self.largest()
        return {
            "n_piled": (count, ""),
            "piled_kev": (kev, "keV"),
            "piled_ns": (after_ns, "ns"),
        }

    def reach(self, dt_ns: float) -> int:
        """Number of samples beyond a record that `added` needs for the earliest pulse."""
        earliest = float(self.after_ns.min(initial=0.0))
        return int(np.ceil(-min(earliest, 0.0) / dt_ns)) + 1

    def added(
        self,
        shapes: npt.NDArray[np.floating],
        energy_kev: FloatArray,
        dt_ns: float,
        length: int,
    ) -> FloatArray:
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
        total = np.zeros((self.n, length))
        shift = self.after_ns / dt_ns
        whole = np.floor(shift).astype(int)
        for i, row in enumerate(self.row):
            late = shift[i] - whole[i]
            shape = (1 - late) * shapes[i, 1:] + late * shapes[i, :-1]
            # sample k of the record is sample k - whole of the shape without its first
            start = whole[i] + 1
            part = shape[max(0, -start) : max(0, length - start)]
            first = max(0, start)
            total[row, first : first + len(part)] += self.kev[i] / energy_kev[row] * part
        return total


@dataclass(frozen=True)
class DrawnPileUp:
    """Parameters of the piled-up pulses to be drawn.

    Parameters
    ----------
    rate_khz
        Rate of the pulses in kHz.
    energies_kev
        Quantiles of their energies in keV, see `cpunet.electronics.tails_law.TailsLaw`.
    dt_ns
        Sampling period in ns.
    """

    rate_khz: float
    energies_kev: tuple[float, ...]
    dt_ns: float

    def draw(self, n: int, before: int, length: int, rng: np.random.Generator) -> InTracePileUp:
        """Draw pulses for records of `length` samples, `before` before the own pulse.

        Raises
        ------
        CpunetError
            If more than `MAX_EXPECTED` pulses are expected in a record.

        Examples
        --------
        1 kHz in a record of 20 us corresponds to 0.02 pulses per trace.

        >>> rng = np.random.default_rng(1)
        >>> piled = DrawnPileUp(1.0, (10, 2615), 20.0).draw(10_000, 250, 1000, rng)
        >>> 150 < len(piled.row) < 250, bool((piled.after_ns >= -5e3).all())
        (True, True)
        """
        record_us = 1e-3 * (length * self.dt_ns)
        expected = self.rate_khz * 1e-3 * record_us
        if expected > MAX_EXPECTED:
            raise CpunetError(
                f"pile-up at {self.rate_khz:g} kHz: {expected:.3g} pulses in a record of "
                f"{record_us:.3g} us, more than {MAX_EXPECTED:g}; give a lower rate"
            )
        row, kev, time_us = earlier_pulses(n, self.rate_khz, record_us, self.energies_kev, rng)
        partner = rng.integers(max(n, 1), size=len(row))
        return InTracePileUp(n, row, kev, 1e3 * time_us - before * self.dt_ns, partner)
