"""Hits of a detector from files of all formats, and what is in such a file."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.peaks import label_peaks
from cpunet.recipes.schema import PeakConfig
from cpunet.simulation.hit_tables import StepTable, hit_format, step_tables
from cpunet.simulation.hits import FloatArray, HitOptions, Hits, IntArray
from cpunet.tables import Lines, counted, span

log = logging.getLogger(__name__)

# Larger than any laboratory and any event.
FARTHEST_MM, MAX_KEV = 1e7, 1e9
# Deposits of an event number that come later are another event, as in remage.
WINDOW_US = 10.0
# Deposits of an event are simulated at once; later ones would change the edge of its pulse.
LATE_NS = 50.0
# Numbers in a row that rise, on average, in files of jobs
_LONG_RISE = 3
# the largest deposit of any source is above the first, the median event below the second
_LEAST_KEV, _MOST_KEV = 5.0, 1e5


def read_hits(path: Path | str, options: HitOptions = HitOptions()) -> Hits:
    """Read the energy deposits of one detector.

    Formats: the hits stored with simulated pulses (``geds/hits``), remage LH5 (``stp``
    tables; the origin in ``detector_origins`` is subtracted), HDF5 and CSV ntuples of
    g4simple (MeV and mm), remage and other programs with Geant4, and NPZ with ``x_mm``,
    ``y_mm``, ``z_mm``, ``edep_keV``, ``offsets``. Units are those of the column's attribute or
    name (``edep_in_keV``, ``x [mm]``). Times without a unit are in ns.

    Events are the deposits of a detector with one event number that follow each other within
    10 µs, so that the decays of a chain are events of their own. Where numbering
    starts anew, as in joined jobs, so do events. If a number comes back it is replaced by one
    above the largest.

    Parameters
    ----------
    path
        Path of the file. A step takes some 240 bytes of memory.
    options
        How it is read; `hits_detector` is the name of the table, or the number or name in the
        column that distinguishes detectors (``det_uid``, ``volID``, ``detector``…). An unknown
        or missing unit is an error.

    Raises
    ------
    CpunetError
        If the file cannot be read, has an unknown format, lacks a column, a unit or the
        detector, contains no energy deposit, or has energies of another unit.
    """
    file, chosen = Path(path), options.hits_detector
    with step_tables(file) as detectors:
        names = ", ".join(detectors)
        if chosen is None and len(detectors) > 1:
            raise CpunetError(
                f"{file}: holds detectors {names}; choose one with `hits_detector`"
            )
        if chosen is not None and not names:
            raise CpunetError(
                f"{file}: its hits name no detector to pick {chosen} by; leave out "
                "`hits_detector`"
            )
        if chosen is not None and chosen not in detectors:
            raise CpunetError(f"{file}: no detector {chosen}; it holds {names}")
        return _hits_of(detectors[chosen or next(iter(detectors))], options)


def holds_hits(path: Path | str) -> bool:
    """Whether a file contains hits rather than pulses.

    Files of simulated pulses that also contain their hits count as files of pulses.
    """
    with suppress(CpunetError):  # the reader of pulses reports the error
        return hit_format(Path(path)) in ("tables", "csv", "npz")
    return False


def _hits_of(table: StepTable, options: HitOptions) -> Hits:
    """Group steps with a deposit by event (see `first_of_event`), in the order of the file.

    Positions are moved to the frame of the crystal. An event whose number an earlier one has
    gets a new one, above the largest. Late deposits of an event draw a warning.

    Raises
    ------
    CpunetError
        If a step has no finite position, time or energy, or a negative energy; if a hit is far
        away, none is left, or energies are of another unit.
    """
    path, steps = table.path, table.steps(options.units)
    event, edep = steps["event"], steps["edep"]
    time = steps.get("time", np.zeros(len(event)))
    # from the frame of the file to that of the crystal
    mirror = np.array([1.0, -1.0, -1.0]) if options.flip_z else np.ones(3)
    position = np.stack([steps[axis] for axis in "xyz"], axis=1)
    position = (position - np.asarray(options.origin)) * mirror
    # written so that NaN fails
    placed = (np.abs(position) <= FARTHEST_MM).all(axis=1) & np.isfinite(time)
    bad = ~(placed & (edep >= 0) & (edep <= MAX_KEV))
    if bad.any():
        raise CpunetError(
            f"{path}: event {event[np.argmax(bad)]}: a step has no finite position or time, or "
            f"no energy of at least 0 (nor may it lie {FARTHEST_MM / 1e6:g} km away or have "
            f"{MAX_KEV / 1e9:g} TeV); check the units and the origin, or remove the event"
        )
    positive, largest = edep > 0, event.max(initial=-1)
    if not positive.any():
        raise CpunetError(f"{path}: no step deposits energy; check the detector's name")
    position, edep = position[positive], edep[positive]
    event, time = event[positive], time[positive]
    first = first_of_event(event, time)
    # steps of one event need not be adjacent, as in files merged from several threads
    order = np.argsort(first, kind="stable")
    starts, counts = np.unique(first, return_counts=True)
    numbers = event[starts]
    again = np.ones(len(numbers), bool)
    again[np.unique(numbers, return_index=True)[1]] = False
    numbers[again] = largest + 1 + np.arange(again.sum())
    offsets = np.concatenate([[0], np.cumsum(counts)])
    hits = Hits.of(position[order], edep[order], offsets, numbers)
    times, begins, energy_kev = time[order], offsets[:-1], hits.energy_kev
    spread = np.maximum.reduceat(times, begins) - np.minimum.reduceat(times, begins)
    if late := int((spread > LATE_NS).sum()):
        log.warning(
            f"{path}: {late} events have deposits more than {LATE_NS:g} ns after their first, "
            "simulated as if at once; if these are other events, give them numbers of their own"
        )
    if energy_kev.max() < _LEAST_KEV or np.median(energy_kev) > _MOST_KEV:
        raise CpunetError(
            f"{path}: the energies of events, up to {energy_kev.max():.4g} keV, are no "
            "deposits in germanium; correct the unit of their column (is it in MeV or eV?), or "
            "give `units` if it names none"
        )
    return hits


def first_of_event(number: IntArray, time_ns: FloatArray) -> IntArray:
    """Index of the first step of the event of each step.

    Steps of a number are parted where none comes for `WINDOW_US` (the decays of a chain are
    simulated as one event), and where the numbering starts anew (jobs joined in one file).

    Examples
    --------
    >>> first_of_event(np.array([4, 4, 9]), np.array([0.0, 3e9, 5.0]))
    array([0, 1, 2])
    >>> first_of_event(np.array([0, 1, 2, 0, 1, 2]), np.zeros(6))
    array([0, 1, 2, 3, 4, 5])
    """
    # Numbers of a job rise. An event that a thread wrote in two blocks ends one such rise and
    # begins another; where more come back otherwise, the numbering has started anew. Rows in
    # another order, as that of time, rise and fall all the time (by two on average).
    starts = np.flatnonzero(np.append(True, np.diff(number) != 0)[: len(number)])
    runs = number[starts]
    falls = np.diff(runs) < 0
    begins, ends = np.append(True, falls), np.append(falls, True)
    order = np.argsort(runs, kind="stable")
    again = np.diff(runs[order]) == 0
    again &= ~(ends[order[:-1]] & begins[order[1:]])
    job_of_run = np.zeros(len(runs), np.int64)
    if again.sum() > 1 and len(runs) >= _LONG_RISE * begins.sum():
        job_of_run[order[1:]] = np.cumsum(again)
    job = np.repeat(job_of_run, np.diff(np.append(starts, len(number))))

    order = np.lexsort((time_ns, job, number))
    new = (np.diff(number[order]) != 0) | (np.diff(job[order]) != 0)
    new |= np.diff(time_ns[order]) > 1000 * WINDOW_US
    starts = np.flatnonzero(np.append(True, new)[: len(number)])
    first = np.empty(len(number), np.int64)
    counts = np.diff(np.append(starts, len(number)))
    first[order] = np.repeat(np.minimum.reduceat(order, starts), counts)
    return first


def hit_columns(hits: Hits) -> dict[str, tuple[npt.NDArray[Any], str]]:
    """Columns of the table as name → (values, units), in the order of the events.

    Examples
    --------
    >>> hits = Hits.of([[0, 0, 10], [5, 0, 12]], [1000, 592.5], [0, 2], [7])
    >>> columns = hit_columns(hits)
    >>> list(columns), columns["event_number"][0]
    (['event_number', 'x', 'y', 'z', 'edep'], array([7, 7]))
    """
    number = hits.event_number[hits.event_of_hit]
    places = {
        axis: (values, "mm") for axis, values in zip("xyz", hits.position_mm.T, strict=True)
    }
    return {"event_number": (number, ""), **places, "edep": (hits.edep_kev, "keV")}


def describe_hits(
    path: Path, peaks: Mapping[str, PeakConfig], units: str = ""
) -> dict[str, Lines]:
    """Describe the hits of a file, detector by detector.

    Parameters
    ----------
    path
        A file for which `holds_hits` is true.
    peaks
        Gamma lines whose events are counted.
    units
        Units that the file does not name, as of `HitOptions`.

    Returns
    -------
    dict
        Topics and texts by name of the detector (``""`` if the file names none): hits, their
        energies, gamma lines and extents in the frame of the file; or the reason why they
        cannot be read.
    """
    detectors: dict[str, Lines] = {}
    with step_tables(path) as tables:
        hits_of: dict[str, Hits] = {}
        for name, table in tables.items():
            try:
                hits_of[name] = _hits_of(table, HitOptions(units=units))
            except CpunetError as error:
                detectors[name] = [("hits", str(error).removeprefix(f"{path}: "))]
    for name, hits in hits_of.items():
        lines = label_peaks(hits.energy_kev, peaks)
        places = {"x": hits.x_mm, "y": hits.y_mm, "z": hits.z_mm, "r": hits.r_mm}
        extents = (
            f"{axis} {span([values.min(), values.max()], 2)}" for axis, values in places.items()
        )
        detectors[name] = [
            ("hits", f"{len(hits.edep_kev)} of {len(hits)} events"),
            ("energy", f"{span([hits.energy_kev.min(), hits.energy_kev.max()])} keV an event"),
            ("lines", counted({peak: int((lines == peak).sum()) for peak in peaks})),
            ("extents", f"{', '.join(extents)} mm"),
        ]
    return detectors
