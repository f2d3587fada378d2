"""Build the library of pre-computed pulses and check it against the exact drift.

A coarse grid of cells covers the detector. At the centre of each cell the interpolated pulses
are compared with drifted ones. Cells that fail are halved. Hits in the finest cells that still
fail are later drifted individually.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from cpunet.progress import Stage, stage
from cpunet.simulation.field_lookup import DriftMaps, drift_maps
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.library_drift import MARGIN_NS, IntArray, bend, compare, drift_nodes
from cpunet.simulation.library_lookup import LATE, OUTSIDE, UNTRIED, PulseLibrary
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.signals import EXACT, WHOLE_ON_AVERAGE, Task, drift_task

# Energies of the pulses of a self-repelling cloud: Chebyshev points in the squared width.
_ENERGIES_KEV = (0.0, 430.0, 1820.0, 2700.0)
# Grid points drifted at once.
_BLOCK = 256
_CORNERS = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])


def _blocks(n: int, bar: Stage) -> Iterator[slice]:
    for begin in range(0, n, _BLOCK):
        yield slice(begin, min(begin + _BLOCK, n))
        bar.update(min(_BLOCK, n - begin))


def build_library(fields: FieldMaps, settings: SimulationSettings) -> PulseLibrary:
    """Simulate pulses on an adaptive grid, in parallel.

    At the centre of each cell, at azimuths between those of its nodes, the interpolated pulse
    is compared with a drifted one. The cell is halved, at most ``library_halvings`` times, if
    samples differ by more than ``library_tolerance`` of full scale, or if the largest rise in
    one sample differs by more than this relative to itself.

    Parameters
    ----------
    fields
        Field maps of the detector.
    settings
        Simulation settings, including those named `library_...`.
    """
    maps, task = drift_maps(fields, settings), drift_task(fields, settings)
    if task.rounding != EXACT:  # jumps from place to place could not be interpolated
        task = task._replace(rounding=WHOLE_ON_AVERAGE)
    library = _empty(fields, settings)
    size = 2**settings.library_halvings
    nr, nz = library.cell.shape
    cells = size * _lattice(nr // size, nz // size)
    with stage("Library of pulses") as bar:  # grid points; how many more is not known
        while size > 0:
            library = _with_nodes(library, maps, task, _new_corners(library, cells, size), bar)
            complete, halved = _sorted(library, cells, size)
            library = _with_cells(library, complete, size)
            worst = np.zeros(len(complete))
            for block in _blocks(len(complete), bar):
                compare(library, maps, task, complete[block] + size / 2, worst[block])
            bad = complete[worst > settings.library_tolerance]
            _enter(library.cell, bad, size, np.zeros(len(bad), np.int64))
            size //= 2
            cells = np.concatenate([halved, bad])
            cells = (cells[:, None] + size * _CORNERS).reshape(-1, 2)
    return library


def _empty(fields: FieldMaps, settings: SimulationSettings) -> PulseLibrary:
    finest = settings.library_grid_mm / 2**settings.library_halvings
    nr, nz = (
        2**settings.library_halvings
        * math.ceil((n - 1) * fields.grid_mm / settings.library_grid_mm)
        for n in fields.potential_V.shape
    )
    energies = _ENERGIES_KEV if settings.self_repulsion else _ENERGIES_KEV[:1]
    return PulseLibrary(
        pulses=np.zeros(0, np.float32),
        start=np.zeros(0, np.int64),
        samples=np.zeros(0, np.int64),
        half_ns=np.zeros(0),
        final=np.zeros(0, np.float32),
        trapped=np.zeros(0),
        cell=np.zeros((nr, nz), np.int64),
        number=np.zeros((nr, nz), np.int64),
        bend_ns=np.zeros((0, 2, settings.library_angles), np.float32),
        column=np.full((nr + 1, nz + 1), UNTRIED, np.int64),
        energies_kev=np.array(energies),
        cos4=np.cos(np.linspace(0, np.pi, settings.library_angles)),
        phases=_phases(settings),
        margin=math.ceil(MARGIN_NS / settings.dt_ns) + 1,
        dt_ns=settings.dt_ns,
        per_mm=1 / finest,
    )


def _phases(settings: SimulationSettings) -> int:
    """Fine samples per sample: whole steps each, none longer than requested."""
    per_sample = settings.steps_per_sample
    wanted = settings.dt_ns / settings.library_step_ns - 1e-9
    return next(
        n
        for n in range(1, per_sample + 1)
        if (per_sample % n == 0 and n >= wanted) or n == per_sample
    )


def _new_corners(library: PulseLibrary, cells: IntArray, size: int) -> IntArray:
    """Corners (n, 2) of cells at which no charge has been drifted yet."""
    new = np.zeros(library.column.shape, np.bool_)
    new[tuple((cells[:, None] + size * _CORNERS).reshape(-1, 2).T)] = True
    # in a single memory layout: another would compile the whole drift again
    return np.ascontiguousarray(np.argwhere(new & (library.column == UNTRIED)))


def _with_nodes(
    library: PulseLibrary, maps: DriftMaps, task: Task, places: IntArray, bar: Stage
) -> PulseLibrary:
    """Add columns of pulses at further grid points (n, 2), given in fine steps."""
    azimuths = len(library.cos4)
    longest = library.margin + task.n_samples
    rows = len(library.energies_kev) * library.phases
    pulses, found = [library.pulses], []
    n_columns = len(library.samples) // azimuths
    for block in _blocks(len(places), bar):
        here = places[block]
        scratch = np.empty((len(here) * azimuths, rows, longest), np.float32)
        facts = np.zeros((len(here) * azimuths, 5))
        drift_nodes(library, maps, task, here, scratch, facts)
        state = facts[:, 0].reshape(-1, azimuths).min(axis=1)
        stored = state >= 0
        library.column[tuple(here.T)] = np.where(
            stored, n_columns + np.cumsum(stored) - 1, state.astype(np.int64)
        )
        n_columns += int(stored.sum())
        kept = np.repeat(stored, azimuths)
        facts, scratch = facts[kept], scratch[kept]
        within = np.arange(longest) < facts[:, 1, None]
        pulses.append(scratch[np.broadcast_to(within[:, None], scratch.shape)])
        found.append(facts)
    new = np.concatenate([np.zeros((0, 5)), *found])
    samples = np.concatenate([library.samples, new[:, 1].astype(np.int64)])
    return library._replace(
        pulses=np.concatenate(pulses),
        start=np.cumsum(samples * rows) - samples * rows,
        samples=samples,
        half_ns=np.concatenate([library.half_ns, new[:, 2]]),
        final=np.concatenate([library.final, new[:, 3].astype(np.float32)]),
        trapped=np.concatenate([library.trapped, new[:, 4]]),
    )


def _sorted(library: PulseLibrary, cells: IntArray, size: int) -> tuple[IntArray, IntArray]:
    """Cells with pulses at all corners, and cells at an edge, which are to be halved."""
    corners = library.column[tuple(np.moveaxis(cells[:, None] + size * _CORNERS, -1, 0))]
    known, outside, late = corners >= 0, corners == OUTSIDE, corners == LATE
    # a late corner remains late in smaller cells
    return cells[known.all(1)], cells[known.any(1) & outside.any(1) & ~late.any(1)]


def _with_cells(library: PulseLibrary, cells: IntArray, size: int) -> PulseLibrary:
    """Add cells in which pulses are interpolated."""
    _enter(library.cell, cells, size, np.full(len(cells), size))
    _enter(library.number, cells, size, len(library.bend_ns) + np.arange(len(cells)))
    bends = np.zeros((len(cells), *library.bend_ns.shape[1:]), np.float32)
    bend(library, cells, size, bends)
    return library._replace(bend_ns=np.concatenate([library.bend_ns, bends]))


def _enter(table: IntArray, cells: IntArray, size: int, values: IntArray) -> None:
    """Set all fine cells inside each cell to its value."""
    inside = cells[:, None] + _lattice(size, size)
    table[tuple(np.moveaxis(inside, -1, 0))] = values[:, None]


def _lattice(nr: int, nz: int) -> IntArray:
    """All pairs (nr * nz, 2) of whole numbers from 0."""
    return np.indices((nr, nz)).reshape(2, -1).T.astype(np.int64)
