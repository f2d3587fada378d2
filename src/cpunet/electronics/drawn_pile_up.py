"""Random pile-up: tails for translated pulses, distributed as in the data, and later pulses.

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

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.exponentials import FloatArray as Values
from cpunet.electronics.pile_up_tails import PileUpTails
from cpunet.electronics.tails_law import TailsLaw, earlier_pulses, tail_shape
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import CutWindows, apply_cuts, prepare
from cpunet.recipes.schema import PreparationConfig

# Tails in keV at which the probability of passing the cuts is measured.
SIZES_KEV = (0.0, *np.geomspace(3.0, 3000.0, 25).tolist())
TEMPLATES, MIN_TEMPLATES = 150, 20  # traces to which tails are added


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
            sizes = np.log1p(kev[again])
            passes = np.interp(sizes, np.log1p(SIZES_KEV), self.passed)
            again = again[rng.random(len(again)) >= passes]
            if not len(again):
                break
            kev[again] = self.draw(len(again), rng)
        return kev

    def decay(self, length: int, lead_us: float | None = None) -> Values:
        """Tail of 1 keV at each sample of a record, shape ``(length,)``."""
        lead_us = self.lead_us if lead_us is None else lead_us
        return tail_shape(length, self.dt_ns, self.decay_us, lead_us)

    def factors(
        self, energy_kev: npt.NDArray[np.float64], rng: np.random.Generator
    ) -> FloatArray:
        """Draw tails for pulses of given energies, in prepared units."""
        kev = self.draw_kev(len(energy_kev), rng)
        return np.asarray(kev * self.height / energy_kev, np.float32)


@dataclass(frozen=True, eq=False)
class TraceNoise:
    """Noise and pile-up tails: everything that is added to a record.

    Parameters
    ----------
    noise
        Noise of the baselines.
    tails
        Pile-up tails, or None for noise alone.
    """

    noise: BaselineNoise
    tails: DrawnTails | None = None

    @property
    def dt_ns(self) -> float:
        """Sampling period of the noise in ns."""
        return self.noise.dt_ns

    def draw(
        self, energy_kev: npt.NDArray[np.float64], length: int, rng: np.random.Generator
    ) -> FloatArray:
        """Draw noise as `BaselineNoise.draw`, with pile-up tails added."""
        drawn = self.noise.draw(energy_kev, length, rng)
        if self.tails is not None:
            factors = self.tails.factors(energy_kev, rng)
            drawn += factors[:, np.newaxis] * self.tails.decay(length).astype(np.float32)
        return drawn


def passing(
    tails: PileUpTails, traces: Pulses, config: PreparationConfig, cuts: CutWindows
) -> tuple[float, ...] | None:
    """Probability that traces with tails of `SIZES_KEV` pass the quality cuts.

    Parameters
    ----------
    tails
        Tails of the channel.
    traces
        Raw traces that have passed the cuts.
    config, cuts
        Preparation settings and quality cuts.

    Returns
    -------
    tuple of float
        One probability per size, or None if too few traces have no tail.
    """
    raw = traces.waveforms[tails.measure(traces) < tails.fit.sigma_kev][:TEMPLATES]
    if len(raw) < MIN_TEMPLATES:
        return None
    shape = tail_shape(raw.shape[1], tails.dt_ns, tails.decay_us)
    unit = (tails.adc_per_kev * shape).astype(np.float32)
    shares = []
    for kev in SIZES_KEV:
        lifted = Pulses.of(raw + np.float32(kev) * unit, dt_ns=tails.dt_ns)
        shares.append(len(apply_cuts(prepare(lifted, config, "measured"), cuts)) / len(raw))
    return tuple(share / max(shares[0], 1e-9) for share in np.minimum.accumulate(shares))


MAX_EXPECTED = 4.0  # maximum expected number of piled-up pulses per trace

Columns = dict[str, tuple[npt.NDArray[Any], str]]


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
            Rate in kHz, and quantiles of the energies, see
            `cpunet.electronics.tails_law.TailsLaw`.
        dt_ns
            Sampling period in ns.
        before, length
            Samples of a record before the trace's own pulse, and all.
        rng
            Random generator.

        Raises
        ------
        CpunetError
            If more than `MAX_EXPECTED` pulses are expected in a record.

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
            n, rate_khz, record_us, energies_kev, rng, most=MAX_EXPECTED
        )
        partner = rng.integers(max(n, 1), size=len(row))
        return cls(n, row, kev, 1e3 * time_us - before * dt_ns, partner)

    def of_rows(self, rows: npt.NDArray[np.integer]) -> Self:
        """Piled-up pulses of selected traces, with the traces renumbered."""
        place = np.full(self.n, -1)
        place[rows] = np.arange(len(rows))
        inside = place[self.row] >= 0
        return type(self)(
            len(rows),
            place[self.row[inside]],
            self.kev[inside],
            self.after_ns[inside],
            self.partner[inside] % max(len(rows), 1),
        )

    def columns(self) -> Columns:
        """What is in each trace, as columns of a table with their units.

        ``n_piled``: number of piled-up pulses; ``piled_kev``, ``piled_ns``: energy and time of
        the largest, NaN where there is none. All of shape ``(n,)``.
        """
        kev, after_ns = np.full(self.n, np.nan), np.full(self.n, np.nan)
        order = np.argsort(self.kev, kind="stable")  # the largest is written last
        kev[self.row[order]] = self.kev[order]
        after_ns[self.row[order]] = self.after_ns[order]
        return {
            "n_piled": (np.bincount(self.row, minlength=self.n), ""),
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
        energy_kev: Values,
        dt_ns: float,
        length: int,
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
