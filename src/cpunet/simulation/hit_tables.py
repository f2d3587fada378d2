"""Tables of steps: remage's ``stp`` tables, and the ntuples of Geant4 and g4simple."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened, text_attribute
from cpunet.simulation.hit_steps import (
    NEEDED,
    ReadColumn,
    Steps,
    choose,
    detectors_there,
    of_detector,
    roles,
    steps_of,
    unit_factor,
)
from cpunet.simulation.hits import HitOptions

NTUPLES, STEPS = "default_ntuples", "stp"
_G4SIMPLE, _G4SIMPLE_TITLE = f"{NTUPLES}/g4sntuple", "steps data"
_ALL = slice(0, sys.maxsize)
ROWS = 5_000  # rows per part: of the order of 10 MB of steps


class Table(NamedTuple):
    """Path of the table of a detector, and its label there if others share the table."""

    name: str
    label: str | None


def table_of(path: Path, detector: str | None) -> Table:
    """The table of a detector, or of the only one.

    Raises
    ------
    CpunetError
        If it is not there, or several are and none was chosen.
    """
    there = detectors_of(path)
    if not there:
        raise CpunetError(
            f"{path}: no table of {STEPS} or {NTUPLES} has columns for {', '.join(NEEDED)}; "
            "simulate again and write all steps"
        )
    return there[choose(path, list(there), detector) or ""]


def read_table(path: Path, table: Table, options: HitOptions, rows: slice = _ALL) -> Steps:
    """Read the steps of one detector, relative to its origin if the file tells it.

    Columns are arrays with a row per step, or vectors with a row per hit. g4simple's are in
    MeV, mm and ns, those of other tables in the units of their attributes or names.
    """
    if table.name == _G4SIMPLE:
        options = in_g4simples_units(options)
    with opened(path) as file:
        columns = _columns(path, file[table.name], rows)
        steps = steps_of(path, columns, options)
        if table.label is not None:
            steps = of_detector(path, steps, columns, table.label)
        name = table.label or table.name.rpartition("/")[2]
        return steps.moved(-_origin(path, file, name))


def parts_of(path: Path, table: Table, size: int = ROWS) -> tuple[list[slice], int] | None:
    """Divide the rows of a table into parts of at least `size` rows that split no event.

    Returns
    -------
    tuple or None
        The parts and the largest event number; None if several detectors share the table, or
        the rows of an event are not adjacent, as in files merged from several threads.
    """
    with opened(path) as file:
        group = file[table.name]
        numbers = None if table.label else _row_numbers(group[roles(group)["event"][0]])
    if numbers is None:
        return None
    starts = np.flatnonzero(np.append(True, numbers[1:] != numbers[:-1]))
    if len(np.unique(numbers)) != len(starts):
        return None
    cuts = [0]
    while cuts[-1] < len(numbers):
        after = np.searchsorted(starts, cuts[-1] + size)
        cuts.append(int(starts[after]) if after < len(starts) else len(numbers))
    return [slice(a, b) for a, b in pairwise(cuts)], int(numbers.max(initial=-1))


def holds_tables(file: h5py.File) -> bool:
    """Whether a file has tables of remage, Geant4 or g4simple."""
    return any(isinstance(file.get(folder), h5py.Group) for folder in (STEPS, NTUPLES))


def detectors_of(path: Path) -> dict[str, Table]:
    """Detectors by name: that of the table, or the label where several share a table."""
    found: dict[str, Table] = {}
    with opened(path) as file:
        for folder in (STEPS, NTUPLES):
            for name, table in file[folder].items() if folder in file else ():
                if not isinstance(table, h5py.Group) or not set(NEEDED) <= roles(table).keys():
                    continue
                place = f"{folder}/{name}"
                labels = detectors_there(_columns(path, table, _ALL))
                if len(labels) > 1 or (labels and folder == NTUPLES):
                    found |= {label: Table(place, label) for label in labels}
                else:
                    found[str(name)] = Table(place, None)
    return found


def _columns(path: Path, table: h5py.Group, rows: slice) -> Mapping[str, ReadColumn]:
    """Columns of a table, not yet read. The vectors of deposits tell the steps of each row."""
    edep = table[roles(table)["edep"][0]]
    counts = np.diff(_ends(edep, rows)) if _is_vectors(edep) else None
    return {
        str(name): partial(_read, path, str(name), item, rows, counts)
        for name, item in table.items()
    }


def _is_vectors(item: Any) -> bool:
    parts = ("cumulative_length", "flattened_data")
    return isinstance(item, h5py.Group) and all(is_column(item.get(part)) for part in parts)


def _ends(vectors: h5py.Group, rows: slice) -> npt.NDArray[np.int64]:
    """Where the vectors of the rows begin and end among the values."""
    ends = vectors["cumulative_length"]
    first = [ends[rows.start - 1]] if rows.start else [0]
    return np.append(first, ends[rows.start : rows.stop]).astype(np.int64)


def _read(
    path: Path, name: str, item: Any, rows: slice, counts: npt.NDArray[np.int64] | None
) -> tuple[npt.NDArray[Any], str]:
    """Values of a column for all steps of the rows, and its unit."""
    if isinstance(item, h5py.Group) and "pages" in item:
        item = item["pages"]
    unit = text_attribute(item, "units")
    if _is_vectors(item):
        ends = _ends(item, rows)
        if counts is None or not np.array_equal(np.diff(ends), counts):
            raise CpunetError(
                f"{path}: columns {name} and edep differ in length; is the file truncated?"
            )
        flat = item["flattened_data"]
        return np.asarray(flat[ends[0] : ends[-1]]), text_attribute(flat, "units") or unit
    if not isinstance(item, h5py.Dataset) or item.ndim != 1:
        raise CpunetError(f"{path}: column {name} is no array with a value per step or hit")
    values = np.asarray(item[rows.start : rows.stop])
    if counts is None:
        return values, unit
    if len(values) != len(counts):
        raise CpunetError(f"{path}: columns {name} and edep differ in length; truncated?")
    return np.repeat(values, counts), unit


def _row_numbers(item: Any) -> npt.NDArray[Any] | None:
    """Event number of each row of a table."""
    if isinstance(item, h5py.Group) and "pages" in item:
        item = item["pages"]
    if _is_vectors(item):
        ends = _ends(item, _ALL)
        if np.any(np.diff(ends) <= 0):
            return None
        return np.asarray(item["flattened_data"][()])[ends[1:] - 1]
    return np.asarray(item[()]) if is_column(item) and item.ndim == 1 else None


def _origin(path: Path, file: h5py.File, name: str) -> npt.NDArray[np.float64]:
    """Origin of a detector in mm; zero if it is not in the file."""
    origin = np.zeros(3)
    if f"detector_origins/{name}" not in file:
        return origin
    for i, axis in enumerate("xyz"):
        where = f"detector_origins/{name}/{axis}loc"
        number = file.get(where)
        if not is_column(number) or number.size != 1:
            raise CpunetError(f"{path}: {where} is no number; write the file again")
        # an origin may lack a unit; all lengths of remage are in m
        unit = text_attribute(number, "units") or "m"
        origin[i] = number[()].item() * unit_factor(HitOptions(), "x", path, where, unit)
    return origin


def in_g4simples_units(options: HitOptions) -> HitOptions:
    """Options for columns in g4simple's MeV and mm unless others are given."""
    length, energy = options.length_unit or "mm", options.energy_unit or "MeV"
    return replace(options, length_unit=length, energy_unit=energy)


def read_csv(path: Path, options: HitOptions) -> Steps:
    """Read the steps of a CSV ntuple.

    A column name may end with a unit, in brackets or after ``_in_``. Without it, files of
    g4simple (recognised by their title) are in MeV and mm. For all other files the unit must
    be given. Times are in ns, Geant4's unit, unless their name tells another.
    """
    title, columns = _csv_columns(path)
    if title == _G4SIMPLE_TITLE:
        options = in_g4simples_units(options)
    steps = steps_of(path, columns, options)
    return of_detector(path, steps, columns, options.hits_detector)


def csv_detectors(path: Path) -> list[str]:
    """Detectors with deposits, by their number or name; empty if no column tells them."""
    return detectors_there(_csv_columns(path)[1])


def _csv_columns(path: Path) -> tuple[str, Mapping[str, ReadColumn]]:
    """Title of the file, and its columns."""
    title, names = _header(path)
    with path.open(encoding="utf-8", errors="replace") as lines:
        body = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    if not body:
        raise CpunetError(f"{path}: holds no steps; simulate again")
    if (n := body[0].count(",") + 1) != len(names):
        raise CpunetError(f"{path}: {n} values a line for {len(names)} columns; export again")
    cells: npt.NDArray[Any]
    try:
        cells = np.loadtxt(body, delimiter=",", ndmin=2)
    except ValueError:  # names of volumes and processes among the numbers
        rows = [line.split(",") for line in body]
        if any(len(row) != len(names) for row in rows):
            raise CpunetError(
                f"{path}: a line is not {len(names)} values; is it cut off?"
            ) from None
        cells = np.array(rows)

    def reader(at: int) -> ReadColumn:
        return lambda: (_numbers(cells[:, at]), "")

    return title, {name: reader(at) for at, name in enumerate(names)}


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


def _numbers(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Values as numbers, unless one is text."""
    try:
        return values.astype(float)
    except ValueError:
        return values
