"""The ``stp`` tables of remage: a vector of steps per event and detector."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import lh5
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.simulation.hit_readers.steps import Steps, Units

_AXES = ("xloc", "yloc", "zloc")


def read_remage(path: Path, detector: str | None, units: Units) -> Steps:
    """Steps of one table of ``stp``, relative to the detector's origin if the file has it."""
    name = _detector(path, detector)
    table = _read(path, f"stp/{name}")
    missing = [c for c in ("evtid", "edep", *_AXES) if c not in table]
    if missing:
        raise CpunetError(
            f"{path}: stp/{name} has no column {missing[0]}; choose a germanium detector"
        )
    edep, counts = _flat(path, table, "edep")
    edep = edep * units.to_kev(path, f"stp/{name}/edep", _unit(table, "edep"))
    columns = []
    for axis in _AXES:
        values, _ = _flat(path, table, axis)
        if len(values) != len(edep):
            raise CpunetError(f"{path}: stp/{name}: {axis} and edep differ in length")
        columns.append(values * units.to_mm(path, f"stp/{name}/{axis}", _unit(table, axis)))
    numbers = np.asarray(table["evtid"].nda)
    position = np.stack(columns, axis=1) - _origin(path, name, units)
    return Steps(np.repeat(numbers, counts).astype(np.int64), position, edep)


def _detector(path: Path, detector: str | None) -> str:
    with h5py.File(path, "r") as file:
        there = [
            str(name)
            for name, table in file["stp"].items()
            if isinstance(table, h5py.Group) and all(c in table for c in ("edep", *_AXES))
        ]
    names = ", ".join(there)
    if detector is None:
        if len(there) != 1:
            raise CpunetError(
                f"{path}: holds detectors {names}; give detector (--hits-detector) as one"
            )
        return there[0]
    if detector not in there:
        raise CpunetError(f"{path}: no detector {detector}; it holds {names}")
    return detector


def _origin(path: Path, name: str, units: Units) -> npt.NDArray[np.float64]:
    """Origin of a detector in mm; zero if the file does not tell."""
    origin = np.zeros(3)
    with h5py.File(path, "r") as file:
        if f"detector_origins/{name}" not in file:
            return origin
        for i, axis in enumerate(_AXES):
            where = f"detector_origins/{name}/{axis}"
            number = file[where]
            unit = number.attrs.get("units")
            # an origin may come without a unit; all lengths of remage are in m
            origin[i] = float(number[()]) * units.to_mm(path, where, unit or "m")
    return origin


def _read(path: Path, name: str) -> Any:
    try:
        return lh5.read(name, str(path))
    # truncated and foreign files fail in as many ways as the library has layers
    except Exception as error:
        raise CpunetError(f"{path}: {name} cannot be read; is the file truncated?") from error


def _flat(
    path: Path, table: Any, column: str
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """All steps' values of a column, and the number of steps per row."""
    vectors = table[column]
    if not hasattr(vectors, "cumulative_length"):
        values = np.asarray(vectors.nda, float)
        return values, np.ones(len(values), np.int64)
    ends = np.asarray(vectors.cumulative_length.nda, np.int64)
    values = np.asarray(vectors.flattened_data.nda, float)
    counts = np.diff(ends, prepend=0)
    if len(ends) != len(table["evtid"]) or np.any(counts < 0) or ends[-1:].sum() > len(values):
        raise CpunetError(f"{path}: column {column} does not divide into events; truncated?")
    return values[: ends[-1] if len(ends) else 0], counts


def _unit(table: Any, column: str) -> str | None:
    vectors = table[column]
    inner = getattr(vectors, "flattened_data", vectors)
    unit = inner.attrs.get("units") or vectors.attrs.get("units")
    return None if unit is None else str(unit)
