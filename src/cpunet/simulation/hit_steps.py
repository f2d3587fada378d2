"""Steps of a simulation: columns of their tables, units, and the hits that they become."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.reading.source import whole_numbers
from cpunet.simulation.hits import (
    FARTHEST_MM,
    LATE_NS,
    MAX_KEV,
    FloatArray,
    HitOptions,
    Hits,
    IntArray,
)

# Numbers in a row that rise, on average, in files of jobs
_LONG_RISE = 3
_MM = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "µm": 1e-3}
_KEV = {"keV": 1.0, "MeV": 1e3, "eV": 1e-3, "GeV": 1e6}
_NS = {"ns": 1.0, "us": 1e3, "µs": 1e3, "ms": 1e6, "s": 1e9, "ps": 1e-3}
# the largest deposit of any source is above the first, the median event below the second
_LEAST_KEV, _MOST_KEV = 5.0, 1e5
# values of a column for all steps, and the unit that belongs to them ("" for none)
ReadColumn = Callable[[], tuple[npt.NDArray[Any], str]]


def in_memory(values: npt.NDArray[Any], unit: str = "") -> ReadColumn:
    """A column that is in memory already."""
    return lambda: (values, unit)


# what a column is, and its names in small letters: the first that is there is read
_NAMES = {
    "event": ("evtid", "event", "event#", "eventid", "event_id", "event_number"),
    "x": ("xloc", "x"),
    "y": ("yloc", "y"),
    "z": ("zloc", "z"),
    "edep": ("edep", "energydeposit"),
    "time": ("time", "t", "globaltime", "t0"),
    "detector": ("det_uid", "detector", "detector_id", "detectorid", "volid", "volume"),
}
NEEDED = ("event", "x", "y", "z", "edep")
_WITH_UNIT = re.compile(r"(.+?)\s*(?:\[(.*)\]|_in_(.+))$")


def unit_factor(
    options: HitOptions, role: str, path: Path, column: str, named: str = ""
) -> float:
    """Conversion factor of a column with the unit `named` to keV, ns or mm.

    `role` is ``"edep"``, ``"time"`` or an axis. Units of columns that name none are those of
    the options; times without a unit are in ns, Geant4's own.

    Raises
    ------
    CpunetError
        If the unit is unknown, or nobody tells it.
    """
    known, option = {"edep": (_KEV, "energy_unit"), "time": (_NS, "")}.get(
        role, (_MM, "length_unit")
    )
    unit = named or (getattr(options, option) if option else "ns")
    if unit is None:
        raise CpunetError(
            f"{path}: column {column} names no unit; give `{option}`: {', '.join(known)}"
        )
    if unit not in known:
        raise CpunetError(
            f"{path}: column {column} is in {unit!r}; expected one of {', '.join(known)}"
        )
    return known[unit]


@dataclass(frozen=True)
class Steps:
    """Steps relative to the detector's origin in the frame of a file; events in any order.

    `time_ns` is None where the file tells no times.
    """

    event: IntArray
    position_mm: FloatArray
    edep_kev: FloatArray
    time_ns: FloatArray | None = None

    def __getitem__(self, kept: npt.NDArray[np.bool_]) -> Steps:
        """Steps that are `kept`."""
        time = None if self.time_ns is None else self.time_ns[kept]
        return Steps(self.event[kept], self.position_mm[kept], self.edep_kev[kept], time)


def to_hits(
    path: Path,
    steps: Steps,
    options: HitOptions,
    first_free: int | None = None,
) -> Hits:
    """Group steps with a deposit by event (see `event_of_step`), in the order of the file.

    Positions are moved to the frame of the crystal. An event whose number an earlier one has
    gets a new one: `first_free` and those after it, by default from the largest on.

    Raises
    ------
    CpunetError
        If a step has no finite position, time or energy, or a negative energy.
    """
    # written so that NaN fails
    placed = (np.abs(steps.position_mm) <= FARTHEST_MM).all(axis=1)
    bad = ~(placed & (steps.edep_kev >= 0) & (steps.edep_kev <= MAX_KEV))
    if steps.time_ns is not None:
        bad |= ~np.isfinite(steps.time_ns)
    if bad.any():
        event = steps.event[np.argmax(bad)]
        raise CpunetError(
            f"{path}: event {event}: a step has no finite position or time, or no energy of at "
            f"least 0 (nor may it lie {FARTHEST_MM / 1e6:g} km away or have "
            f"{MAX_KEV / 1e9:g} TeV); remove the event or simulate again"
        )
    if first_free is None:
        first_free = int(steps.event.max(initial=-1)) + 1
    kept = steps[steps.edep_kev > 0]
    found = event_of_step(kept.event, kept.time_ns, options.time_window_us)
    _, first, label = np.unique(found, return_index=True, return_inverse=True)
    in_file = np.argsort(first)
    rank = np.empty_like(in_file)
    rank[in_file] = np.arange(len(in_file))
    # steps of one event need not be adjacent, as in files merged from several threads
    order = np.argsort(rank[label], kind="stable")
    counts = np.bincount(rank[label], minlength=len(first))
    numbers = kept.event[first[in_file]]
    again = np.ones(len(numbers), bool)
    again[np.unique(numbers, return_index=True)[1]] = False
    numbers[again] = first_free + np.arange(again.sum())
    hits = Hits.of(
        options.to_crystal(kept.position_mm[order]),
        kept.edep_kev[order],
        np.concatenate([[0], np.cumsum(counts)]),
        numbers,
    )
    if kept.time_ns is None or not len(counts):
        return hits
    times, starts = kept.time_ns[order], hits.offsets[:-1]
    spread = np.maximum.reduceat(times, starts) - np.minimum.reduceat(times, starts)
    return replace(hits, n_late=int((spread > LATE_NS).sum()))


def require_some(path: Path, n_events: int) -> None:
    """Raise a `CpunetError` if there is no event with a deposit."""
    if not n_events:
        raise CpunetError(f"{path}: no step deposits energy; check the detector's name")


def require_physics(path: Path, energy_kev: FloatArray) -> None:
    """Raise a `CpunetError` if the energies of events are those of another unit."""
    if len(energy_kev) and not (
        energy_kev.max() >= _LEAST_KEV and np.median(energy_kev) <= _MOST_KEV
    ):
        raise CpunetError(
            f"{path}: the energies of events, up to {energy_kev.max():.4g} keV, are no "
            "deposits in germanium; correct the unit of their column (is it in MeV or eV?), or "
            "give `energy_unit` if it names none"
        )


def event_of_step(number: IntArray, time_ns: FloatArray | None, window_us: float) -> IntArray:
    """Label of the event of each step; labels are arbitrary, equal within an event.

    Steps of a number are parted where none comes for `window_us` (the decays of a chain are
    simulated as one event), and where the numbering starts anew (jobs joined in one file).

    Examples
    --------
    >>> event_of_step(np.array([4, 4, 9]), np.array([0.0, 3e9, 5.0]), 10)
    array([0, 1, 2])
    >>> event_of_step(np.array([0, 1, 2, 0, 1, 2]), None, 10)
    array([0, 2, 4, 1, 3, 5])
    """
    job = _job_of_step(number)
    keys = (job, number) if time_ns is None else (time_ns, job, number)
    order = np.lexsort(keys)
    new = (np.diff(number[order]) != 0) | (np.diff(job[order]) != 0)
    if time_ns is not None:
        new |= np.diff(time_ns[order]) > 1000 * window_us
    label = np.empty(len(number), np.int64)
    label[order] = np.cumsum(np.append(0, new))[: len(number)]
    return label


def _job_of_step(number: IntArray) -> IntArray:
    """Index of the job of each step among those with its number.

    The numbers of a job rise. An event that a thread wrote in two blocks ends one such rise and
    begins another; where more come back otherwise, the numbering has started anew. Rows in
    another order, as that of time, rise and fall all the time (by two on average).
    """
    starts = np.flatnonzero(np.append(True, np.diff(number) != 0)[: len(number)])
    runs = number[starts]
    falls = np.diff(runs) < 0
    begins, ends = np.append(True, falls), np.append(falls, True)
    order = np.argsort(runs, kind="stable")
    again = np.diff(runs[order]) == 0
    again &= ~(ends[order[:-1]] & begins[order[1:]])
    job = np.zeros(len(runs), np.int64)
    if again.sum() > 1 and len(runs) >= _LONG_RISE * begins.sum():
        job[order[1:]] = np.cumsum(again)
    return np.repeat(job, np.diff(np.append(starts, len(number))))


def roles(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """What there is among the `names` of columns: role → (name, unit in the name or ``""``).

    Examples
    --------
    >>> roles(["evtid", "edep_in_keV", "X [mm]"])
    {'event': ('evtid', ''), 'x': ('X [mm]', 'mm'), 'edep': ('edep_in_keV', 'keV')}
    """
    plain: dict[str, tuple[str, str]] = {}
    for name in names:
        match = _WITH_UNIT.match(name)
        base, unit = (match[1], (match[2] or match[3] or "").strip()) if match else (name, "")
        plain.setdefault(base.lower(), (name, unit))
    found = {}
    for role, known in _NAMES.items():
        if there := [plain[name] for name in known if name in plain]:
            found[role] = there[0]
    return found


@dataclass(frozen=True)
class Columns:
    """Columns of a table of steps, by name, each of which is read when it is needed."""

    path: Path
    read: Mapping[str, ReadColumn]

    @cached_property
    def roles(self) -> dict[str, tuple[str, str]]:
        """What there is, see `roles`."""
        return roles(self.read)

    def steps(self, options: HitOptions) -> Steps:
        """Steps of all detectors.

        Raises
        ------
        CpunetError
            If a column is missing, is no number, names no known unit or differs in length.
        """
        path, found = self.path, self.roles
        if missing := [role for role in NEEDED if role not in found]:
            raise CpunetError(
                f"{path}: no column for {missing[0]}; the file holds {', '.join(self.read)}"
            )
        values: dict[str, npt.NDArray[Any]] = {}
        for role, (name, in_name) in found.items():
            if role == "detector":
                continue
            read, unit = self.read[name]()
            if read.ndim != 1 or read.dtype.kind not in "iuf":
                raise CpunetError(
                    f"{path}: column {name} is of {read.dtype} and shape {read.shape}; give "
                    "one number per step (g4simple: its option for steps)"
                )
            if role == "event":
                values[role] = whole_numbers(read, f"{path}: column {name}")
            else:
                values[role] = read * unit_factor(options, role, path, name, unit or in_name)
            if len(read) != len(values["event"]):
                raise CpunetError(
                    f"{path}: columns {name} and {found['event'][0]} differ in length; "
                    "truncated?"
                )
        position = np.stack([values[axis] for axis in "xyz"], axis=1)
        return Steps(values["event"], position, values["edep"], values.get("time"))

    def labels(self) -> npt.NDArray[np.str_] | None:
        """Detector of each step as text, or None if no column tells it."""
        if "detector" not in self.roles:
            return None
        labels = self.read[self.roles["detector"][0]]()[0]
        if labels.dtype.kind == "f" and np.array_equal(labels, np.rint(labels)):
            labels = labels.astype(np.int64)
        if labels.dtype.kind in "SO":
            return np.array([x.decode() if isinstance(x, bytes) else str(x) for x in labels])
        return labels.astype(np.str_)

    def detectors(self) -> list[str]:
        """Detectors with deposits; those without are the world or a holder."""
        labels = self.labels()
        if labels is None or "edep" not in self.roles:
            return []
        edep = self.read[self.roles["edep"][0]]()[0]
        if len(edep) != len(labels):
            return []  # the reader of the steps reports it
        return sorted(
            map(str, np.unique(labels[edep > 0])),
            key=lambda label: (len(label), label) if label.isdigit() else (99, label),
        )

    def steps_of(self, detector: str | None, options: HitOptions) -> Steps:
        """Steps of a detector by its label, or of the only one if none is given."""
        steps, labels = self.steps(options), self.labels()
        if labels is not None and len(labels) != len(steps.event):
            raise CpunetError(
                f"{self.path}: the column of detectors differs in length; truncated?"
            )
        choose(self.path, self.detectors(), detector)
        return steps if labels is None or detector is None else steps[labels == detector]


def choose(path: Path, there: list[str], detector: str | None) -> str | None:
    """The detector wanted, or the only one there.

    Raises
    ------
    CpunetError
        If it is not there, or several are and none was chosen.
    """
    if detector is not None and not there:
        raise CpunetError(
            f"{path}: its hits name no detector to pick {detector} by; leave out "
            "`hits_detector`"
        )
    names = ", ".join(there)
    if detector is None and len(there) > 1:
        raise CpunetError(f"{path}: holds detectors {names}; choose one with `hits_detector`")
    if detector is not None and detector not in there:
        raise CpunetError(f"{path}: no detector {detector}; it holds {names}")
    return detector or next(iter(there), None)
