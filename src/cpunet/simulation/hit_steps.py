"""Steps of a detector in a table, and which of them are one event."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import units_of
from cpunet.pulses.reading.source import Texts, divides, dividing, labels, texts, whole_numbers
from cpunet.simulation.geometry import FloatArray, IntArray
from cpunet.simulation.hits import HitOptions, Hits
from cpunet.units import factor, unit_names

log = logging.getLogger(__name__)

# what a column is, and its names in small letters: the first of these is read
_NAMES = {
    "event": ("evtid", "event", "event#", "eventid", "event_id", "event_number"),
    "x": ("xloc", "x"),
    "y": ("yloc", "y"),
    "z": ("zloc", "z"),
    "edep": ("edep", "energydeposit"),
    "time": ("time", "t", "globaltime", "t0"),
}
NEEDED = ("event", "x", "y", "z", "edep")
_WITH_UNIT = re.compile(r"(.+?)\s*(?:\[(.*)\]|_in_(.+))$")
# Deposits of an event number that come later are another event, as in remage.
WINDOW_US = 10.0
# Deposits of an event are simulated at once; later ones would change the edge of its pulse.
LATE_NS = 50.0
# Numbers in a row that rise, on average, in files of jobs
_LONG_RISE = 3
# the largest deposit of any source is above the first, the median event below the second
_LEAST_KEV, _MOST_KEV = 5.0, 1e5


@dataclass(frozen=True, eq=False)
class StepTable:
    """Steps of a detector: columns by name, arrays or items of an open HDF5 file.

    Those of HDF5 are arrays with a value per row, or vectors with a value per step of the row;
    the vectors of deposits give the steps of each row. The `name` is that of the detector,
    empty without any. `units` are those of columns that name none: MeV and mm in tables of
    g4simple. A `file` of remage tells where its detectors are. Where detectors share the table,
    `labels` are those of the steps, and those with the name are read.
    """

    path: Path
    columns: Mapping[str, Any]
    name: str = ""
    units: str = ""
    file: h5py.File | None = None
    labels: Texts | None = None

    def by_detector(self) -> dict[str, StepTable]:
        """The table, or its parts by the labels of their detectors where several share it.

        Labels without deposits are the world or a holder.
        """
        of = roles(self.columns)
        if missing := [role for role in NEEDED if role not in of]:
            text = f"no column for {missing[0]}; the file holds {', '.join(self.columns)}"
            raise CpunetError(f"{self.path}: {text}")
        deposits = self._read(of["edep"][0])[0] > 0
        dividers = {name: self._read(name)[0] for name in self.columns if divides(name)}
        some = {name: values[deposits] for name, values in dividers.items()}
        names = dividing(some, int(deposits.sum())) or list(dividers)[:1]
        if not names:
            return {self.name: self}
        of_steps = texts(dividers[names[0]]) if len(names) == 1 else labels(dividers, names)
        detectors = sorted(map(str, np.unique(of_steps[deposits])), key=lambda x: (len(x), x))
        if len(detectors) <= bool(self.name):
            return {self.name: self}
        return {label: replace(self, name=label, labels=of_steps) for label in detectors}

    def hits(self, options: HitOptions) -> Hits:
        """Group steps with a deposit by event (see `first_of_event`), in the order of the file.

        Positions are moved to the frame of the crystal. An event whose number an earlier one
        has gets a new one, above the largest. Late deposits of an event draw a warning.

        Raises
        ------
        CpunetError
            If a column is no number or names no unit that is understood; if a step has no
            finite position, time or energy, or a negative energy; if no hit is left, or
            energies are of another unit.
        """
        chosen = slice(None) if self.labels is None else self.labels == self.name
        others = *re.split(r"[\s,]+", options.units), *self.units.split(",")
        steps: dict[str, npt.NDArray[Any]] = {}
        for role, (name, in_name) in roles(self.columns).items():
            values, unit = self._read(name)
            where = f"{self.path}: column {name}"
            if values.ndim != 1 or values.dtype.kind not in "iuf":
                raise CpunetError(
                    f"{where} is of {values.dtype} and shape {values.shape}; give one number "
                    "per step (g4simple: its option for steps)"
                )
            if role == "event":
                steps[role] = whole_numbers(values, where)[chosen]
                continue
            steps[role] = (values * _unit_factor(role, where, unit or in_name, others))[chosen]
            origin = f"detector_origins/{self.name}/{role}loc"
            if self.file is not None and origin in self.file:
                # it may lack a unit; all lengths of remage are in m
                item, where = self.file[origin], f"{self.path}: column {origin}"
                to_mm = _unit_factor(role, where, units_of(item), ("m",))
                steps[role] = steps[role] - item[()].item() * to_mm
        event, edep = steps["event"], steps["edep"]
        time = steps.get("time", np.zeros(len(event)))
        # from the frame of the file to that of the crystal
        mirror = np.array([1.0, -1.0, -1.0]) if options.flip_z else np.ones(3)
        position = np.stack([steps[axis] for axis in "xyz"], axis=1)
        position = (position - np.asarray(options.origin)) * mirror
        placed = np.isfinite(position).all(axis=1) & np.isfinite(time)
        bad = ~(placed & (edep >= 0) & np.isfinite(edep))  # NaN is not above 0
        if bad.any():
            raise CpunetError(
                f"{self.path}: event {event[np.argmax(bad)]}: a step has no finite position or "
                "time, or no energy of at least 0; check the units and the origin, or remove "
                "the event"
            )
        positive = np.flatnonzero(edep > 0)
        if not len(positive):
            raise CpunetError(
                f"{self.path}: no step deposits energy; check the detector's name"
            )
        first = first_of_event(event[positive], time[positive])
        # steps of one event need not be adjacent, as in files merged from several threads
        order = positive[np.argsort(first, kind="stable")]
        starts, counts = np.unique(first, return_counts=True)
        numbers = event[positive][starts]
        again = np.ones(len(numbers), bool)
        again[np.unique(numbers, return_index=True)[1]] = False
        numbers[again] = event.max() + 1 + np.arange(again.sum())
        offsets = np.concatenate([[0], np.cumsum(counts)])
        hits, times = Hits.of(position[order], edep[order], offsets, numbers), time[order]
        ends = (of.reduceat(times, offsets[:-1]) for of in (np.maximum, np.minimum))
        spread = np.subtract(*ends)
        if late := int((spread > LATE_NS).sum()):
            log.warning(
                f"{self.path}: {late} events have deposits more than {LATE_NS:g} ns after "
                "their first, simulated as if at once; if these are other events, give them "
                "numbers of their own"
            )
        most = hits.energy_kev.max()
        if most < _LEAST_KEV or np.median(hits.energy_kev) > _MOST_KEV:
            raise CpunetError(
                f"{self.path}: the energies of events, up to {most:.4g} keV, are no deposits "
                "in germanium; correct the unit of their column (is it in MeV or eV?), or "
                "give `units` if it names none"
            )
        return hits

    def _read(self, name: str) -> tuple[npt.NDArray[Any], str]:
        """Values of a column for all steps, and the unit that belongs to them."""
        item, edep = self.columns[name], self.columns[roles(self.columns)["edep"][0]]
        where, parts = f"{self.path}: column", {"cumulative_length", "flattened_data"}
        vectors = isinstance(item, h5py.Group) and parts <= item.keys()
        if not vectors and getattr(item, "ndim", 0) != 1:
            raise CpunetError(f"{where} {name} is no array with a value per step or hit")
        # each row ends with one of the steps
        ends, of_edep = (
            column["cumulative_length"][()].astype(np.int64)
            if isinstance(column, h5py.Group)
            else np.arange(len(column)) + 1
            for column in (item, edep)
        )
        if len(ends) != len(of_edep) or (vectors and not np.array_equal(ends, of_edep)):
            raise CpunetError(f"{where}s {name} and edep differ in length; truncated?")
        if vectors:
            flat = item["flattened_data"]
            return np.asarray(flat[: ends.max(initial=0)]), units_of(flat) or units_of(item)
        unit = units_of(item) if isinstance(item, h5py.Dataset) else ""
        return np.repeat(item[()], np.diff(of_edep, prepend=0)), unit


def roles(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """What the columns of these `names` are: role → (name, unit in the name or ``""``).

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
    return {
        role: plain[next(filter(plain.__contains__, spellings))]
        for role, spellings in _NAMES.items()
        if not plain.keys().isdisjoint(spellings)
    }


def _unit_factor(role: str, where: str, unit: str, others: Iterable[str]) -> float:
    """Conversion factor of a column in a `unit` to keV, ns or mm.

    `role` is ``"edep"``, ``"time"`` or an axis. A column that names no unit is in the first of
    the others that is of its kind. Times without a unit are in ns, Geant4's own.

    Raises
    ------
    CpunetError
        If the unit is not understood, or nobody tells it.
    """
    to = {"edep": "keV", "time": "ns"}.get(role, "mm")
    unit = unit or next((other for other in (*others, "ns") if factor(other, to)), "")
    if not unit:
        raise CpunetError(f"{where} names no unit; give `units`, one of {unit_names(to)}")
    if (to_ours := factor(unit, to)) is None:
        raise CpunetError(f"{where} is in {unit!r}; expected one of {unit_names(to)}")
    return to_ours


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
