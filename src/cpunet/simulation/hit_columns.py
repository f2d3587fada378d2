"""Columns of a table of steps: what they are called, their units, and the detector."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.simulation.hit_steps import Steps, unit_factor, whole_numbers
from cpunet.simulation.hits import HitOptions

# values of a column for all steps, and the unit that belongs to them ("" for none)
ReadColumn = Callable[[], tuple[npt.NDArray[Any], str]]

# what a column is, and its names in small letters: the first that is there is read
_NAMES = {
    "event": ("evtid", "event", "event#", "eventid", "event_id"),
    "x": ("xloc", "x"),
    "y": ("yloc", "y"),
    "z": ("zloc", "z"),
    "edep": ("edep", "energydeposit"),
    "time": ("time", "t", "globaltime", "t0"),
    "detector": ("det_uid", "detector", "detector_id", "detectorid", "volid", "volume"),
}
NEEDED = ("event", "x", "y", "z", "edep")
_WITH_UNIT = re.compile(r"(.+?)\s*(?:\[(.*)\]|_in_(.+))$")


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


def steps_of(path: Path, columns: Mapping[str, ReadColumn], options: HitOptions) -> Steps:
    """Steps of a table with these columns.

    Raises
    ------
    CpunetError
        If a column is missing, is no number, names no known unit or differs in length.
    """
    found = roles(columns)
    if missing := [role for role in NEEDED if role not in found]:
        raise CpunetError(
            f"{path}: no column for {missing[0]}; the file holds {', '.join(columns)}"
        )
    values: dict[str, npt.NDArray[Any]] = {}
    for role, (name, in_name) in found.items():
        if role == "detector":
            continue
        read, unit = columns[name]()
        if read.ndim != 1 or read.dtype.kind not in "iuf":
            raise CpunetError(
                f"{path}: column {name} is of {read.dtype} and shape {read.shape}; give one "
                "number per step (g4simple: its option for steps)"
            )
        if role == "event":
            values[role] = whole_numbers(path, name, read)
        else:
            values[role] = read * unit_factor(options, role, path, name, unit or in_name)
        if len(read) != len(values["event"]):
            raise CpunetError(
                f"{path}: columns {name} and {found['event'][0]} differ in length; truncated?"
            )
    position = np.stack([values[axis] for axis in "xyz"], axis=1)
    return Steps(values["event"], position, values["edep"], values.get("time"))


def detector_labels(columns: Mapping[str, ReadColumn]) -> npt.NDArray[np.str_] | None:
    """Detector of each step as text, or None if no column tells it."""
    name, _ = roles(columns).get("detector", ("", ""))
    if not name:
        return None
    labels = columns[name]()[0]
    if labels.dtype.kind == "f" and np.array_equal(labels, np.rint(labels)):
        labels = labels.astype(np.int64)
    if labels.dtype.kind in "SO":
        return np.array([x.decode() if isinstance(x, bytes) else str(x) for x in labels])
    return labels.astype(np.str_)


def detectors_there(columns: Mapping[str, ReadColumn]) -> list[str]:
    """Detectors with deposits; those without are the world or a holder."""
    labels, found = detector_labels(columns), roles(columns)
    if labels is None or "edep" not in found:
        return []
    edep = columns[found["edep"][0]]()[0]
    if len(edep) != len(labels):
        return []  # the reader of the steps reports it
    there = [str(label) for label in np.unique(labels[edep > 0])]
    return sorted(
        there, key=lambda label: (len(label), label) if label.isdigit() else (99, label)
    )


def of_detector(
    path: Path, steps: Steps, columns: Mapping[str, ReadColumn], detector: str | None
) -> Steps:
    """Steps of a detector by its label, or of the only one if none is given."""
    labels = detector_labels(columns)
    if labels is None:
        if detector is not None:
            raise CpunetError(f"{path}: no column to pick detector {detector} by")
        return steps
    if len(labels) != len(steps.event):
        raise CpunetError(f"{path}: the column of detectors differs in length; truncated?")
    there = detectors_there(columns)
    choose(path, there, detector)
    return steps if detector is None else steps[labels == detector]


def choose(path: Path, there: list[str], detector: str | None) -> str | None:
    """The detector wanted, or the only one there.

    Raises
    ------
    CpunetError
        If it is not there, or several are and none was chosen.
    """
    names = ", ".join(there) or "none"
    if detector is None and len(there) > 1:
        raise CpunetError(f"{path}: holds detectors {names}; choose one with `hits_detector`")
    if detector is not None and detector not in there:
        raise CpunetError(f"{path}: no detector {detector}; it holds {names}")
    return detector or next(iter(there), None)
