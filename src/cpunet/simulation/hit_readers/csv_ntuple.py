"""CSV ntuples as Geant4's analysis manager writes them, one step per line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.simulation.hit_readers.g4simple import of_detector
from cpunet.simulation.hit_readers.steps import Steps, Units, whole_numbers

_NAMES = {
    "event": ("event", "event#", "eventid", "evtid"),
    "detector": ("detector_id", "volid", "detectorid"),
    "edep": ("edep", "energydeposit"),
    "x": ("x", "xloc"),
    "y": ("y", "yloc"),
    "z": ("z", "zloc"),
}
_G4SIMPLE_TITLE = "steps data"


def read_csv(path: Path, detector: str | None, units: Units) -> Steps:
    """Read the steps of a CSV ntuple.

    A column name may end with a unit in brackets. Without it, files of g4simple (recognised
    by their title) are in MeV and mm. For all other files the unit must be given.
    """
    title, columns = _header(path)
    found = ((kind, _find(columns, names)) for kind, names in _NAMES.items())
    place = {kind: at for kind, at in found if at is not None}
    if missing := [kind for kind in _NAMES if kind not in place and kind != "detector"]:
        held = ", ".join(columns)
        raise CpunetError(f"{path}: no column for {missing[0]}; the file holds {held}")
    data = _numbers(path, len(columns))
    if title == _G4SIMPLE_TITLE:
        units = Units(units.length or "mm", units.energy or "MeV")

    def converted(kind: str, factor: Callable[..., float]) -> npt.NDArray[np.float64]:
        name = columns[place[kind]]
        return np.asarray(data[:, place[kind]] * factor(path, name, _split(name)[1]))

    steps = Steps(
        whole_numbers(path, columns[place["event"]], data[:, place["event"]]),
        np.stack([converted(axis, units.to_mm) for axis in "xyz"], axis=1),
        converted("edep", units.to_kev),
    )
    if "detector" in place:
        return of_detector(path, steps, data[:, place["detector"]], detector)
    if detector is not None:
        raise CpunetError(f"{path}: no column to pick detector {detector} by")
    return steps


def _header(path: Path) -> tuple[str, list[str]]:
    title, columns = "", []
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if not line.startswith("#"):
                break
            key, _, value = line[1:].strip().partition(" ")
            if key == "title":
                title = value
            elif key == "column":
                columns.append(value.partition(" ")[2])
            elif key == "separator" and value != "44":
                raise CpunetError(f"{path}: columns are not separated by commas; export again")
    return title, columns


def _split(name: str) -> tuple[str, str | None]:
    plain, bracket, unit = name.partition("[")
    return plain.strip().lower(), unit.rstrip("] ") if bracket else None


def _find(columns: list[str], names: tuple[str, ...]) -> int | None:
    plain = [_split(column)[0] for column in columns]
    return next((plain.index(name) for name in names if name in plain), None)


def _numbers(path: Path, n_columns: int) -> npt.NDArray[np.float64]:
    try:
        with path.open(encoding="utf-8") as lines:
            # np.loadtxt warns about an empty table; the message below is clearer
            body = [line for line in lines if line.strip() and not line.startswith("#")]
        if not body:
            raise CpunetError(f"{path}: holds no steps; simulate again")
        data = np.loadtxt(body, delimiter=",", ndmin=2)
    except ValueError as error:
        raise CpunetError(
            f"{path}: a line is not {n_columns} numbers; is it cut off?"
        ) from error
    if data.shape[1] != n_columns:
        raise CpunetError(
            f"{path}: {data.shape[1]} numbers a line for {n_columns} columns; export again"
        )
    return np.asarray(data, float)
