"""The ``stp`` tables of remage: a vector of steps per event and detector."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, lh5_rows, opened, text_attribute
from cpunet.simulation.hit_readers.steps import Steps, Units, whole_numbers

_AXES = ("xloc", "yloc", "zloc")
ROWS = 5_000  # rows per part: of the order of 10 MB of steps


def read_remage(
    path: Path, detector: str | None, units: Units, rows: slice = slice(0, sys.maxsize)
) -> Steps:
    """Read the steps of one ``stp`` table, relative to the detector's origin if it is known."""
    name = _detector(path, detector)
    table = _read(path, f"stp/{name}", rows)
    edep, counts = _flat(path, table, "edep")
    edep = edep * units.to_kev(path, f"stp/{name}/edep", _unit(table, "edep"))
    columns = []
    for axis in _AXES:
        values, same = _flat(path, table, axis)
        if not np.array_equal(same, counts):
            raise CpunetError(f"{path}: stp/{name}: {axis} and edep differ in length")
        columns.append(values * units.to_mm(path, f"stp/{name}/{axis}", _unit(table, axis)))
    numbers = whole_numbers(path, f"stp/{name}/evtid", _real(path, "evtid", table["evtid"]))
    position = np.stack(columns, axis=1) - _origin(path, name, units)
    return Steps(np.repeat(numbers, counts), position, edep)


def parts_of(path: Path, detector: str | None, size: int = ROWS) -> list[slice] | None:
    """Divide the rows of a table into parts of at least `size` rows that split no event.

    Returns
    -------
    list of slice or None
        None if the rows of an event are not adjacent, as in files merged from several threads.
    """
    name = _detector(path, detector)
    with opened(path) as file:
        item = file.get(f"stp/{name}/evtid")
        if not is_column(item) or item.ndim != 1:
            return None  # the reader reports the error
        numbers = np.asarray(item[()])
    starts = np.flatnonzero(np.append(True, numbers[1:] != numbers[:-1]))
    if len(np.unique(numbers)) != len(starts):
        return None
    cuts = [0]
    while cuts[-1] < len(numbers):
        after = np.searchsorted(starts, cuts[-1] + size)
        cuts.append(int(starts[after]) if after < len(starts) else len(numbers))
    return [slice(a, b) for a, b in pairwise(cuts)]


def detectors_of(path: Path) -> list[str]:
    """Names of the tables of steps."""
    with opened(path) as file:
        return [
            str(name)
            for name, table in file["stp"].items()
            if isinstance(table, h5py.Group) and all(c in table for c in ("edep", *_AXES))
        ]


def _detector(path: Path, detector: str | None) -> str:
    there = detectors_of(path)
    names = ", ".join(there) or "none"
    if detector is None:
        if not there:
            columns = ", ".join(("edep", *_AXES))
            raise CpunetError(f"{path}: no table of stp has {columns}; simulate again")
        if len(there) > 1:
            raise CpunetError(
                f"{path}: holds detectors {names}; choose one with detector (--hits-detector)"
            )
        return there[0]
    if detector not in there:
        raise CpunetError(f"{path}: no detector {detector}; it holds {names}")
    return detector


def _origin(path: Path, name: str, units: Units) -> npt.NDArray[np.float64]:
    """Origin of a detector in mm; zero if it is not in the file."""
    origin = np.zeros(3)
    with opened(path) as file:
        if f"detector_origins/{name}" not in file:
            return origin
        for i, axis in enumerate(_AXES):
            where = f"detector_origins/{name}/{axis}"
            number = file.get(where)
            if not is_column(number) or number.size != 1:
                raise CpunetError(f"{path}: {where} is no number; write the file again")
            unit = text_attribute(number, "units")
            # an origin may lack a unit; all lengths of remage are in m
            origin[i] = number[()].item() * units.to_mm(path, where, unit or "m")
    return origin


def _read(path: Path, name: str, rows: slice) -> dict[str, Any]:
    """Required columns of a table, as LH5 objects."""
    table = {}
    with opened(path) as file:
        for column in ("evtid", "edep", *_AXES):
            item = file.get(f"{name}/{column}")
            if item is None:
                raise CpunetError(
                    f"{path}: {name} has no column {column}; choose a germanium detector"
                )
            table[column] = lh5_rows(item, rows.start, rows.stop - rows.start)
    return table


def _flat(
    path: Path, table: Any, column: str
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Values of a column for all steps, and the number of steps per row."""
    vectors = table[column]
    if not hasattr(vectors, "cumulative_length"):
        values = _real(path, column, vectors)
        ends = np.arange(1, len(values) + 1)
    else:
        ends = np.asarray(vectors.cumulative_length.nda, np.int64)
        values = _real(path, column, vectors.flattened_data)
    counts = np.diff(ends, prepend=0)
    if len(ends) != len(table["evtid"]) or np.any(counts < 0) or ends[-1:].sum() != len(values):
        raise CpunetError(f"{path}: column {column} does not divide into events; truncated?")
    return values.astype(float), counts


def _real(path: Path, column: str, values: Any) -> npt.NDArray[Any]:
    """Values of a column, in the type of the file: large event numbers are no floats."""
    numbers = np.asarray(getattr(values, "nda", None))
    if numbers.ndim != 1 or numbers.dtype.kind not in "iuf":
        raise CpunetError(f"{path}: column {column} is of {numbers.dtype}; give numbers")
    return numbers


def _unit(table: Any, column: str) -> str | None:
    vectors = table[column]
    inner = getattr(vectors, "flattened_data", vectors)
    unit = inner.attrs.get("units") or vectors.attrs.get("units")
    return None if unit is None else str(unit)
