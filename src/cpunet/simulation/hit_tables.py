"""Tables of steps: remage's ``stp`` tables, and the ntuples of Geant4 and g4simple."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened, text_attribute
from cpunet.simulation.hit_steps import (
    NEEDED,
    Columns,
    Steps,
    choose,
    in_memory,
    roles,
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
        shared = table.label is not None
        steps = columns.steps_of(table.label, options) if shared else columns.steps(options)
        origin = _origin(path, file, table.label or table.name.rpartition("/")[2])
    return replace(steps, position_mm=steps.position_mm - origin)


def parts_of(path: Path, table: Table) -> tuple[list[slice], int] | None:
    """Divide the rows of a table into parts of at least `ROWS` rows that split no event.

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
        after = np.searchsorted(starts, cuts[-1] + ROWS)
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
                labels = _columns(path, table, _ALL).detectors()
                if len(labels) > 1 or (labels and folder == NTUPLES):
                    found |= {label: Table(place, label) for label in labels}
                else:
                    found[str(name)] = Table(place, None)
    return found


def _columns(path: Path, table: h5py.Group, rows: slice) -> Columns:
    """Columns of a table, not yet read. The vectors of deposits tell the steps of each row."""
    edep = table[roles(table)["edep"][0]]
    counts = np.diff(_ends(edep, rows)) if _is_vectors(edep) else None
    read = {
        str(name): partial(_read, path, str(name), item, rows, counts)
        for name, item in table.items()
    }
    return Columns(path, read)


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
        ends, flat = _ends(item, rows), item["flattened_data"]
        same = counts is not None and np.array_equal(np.diff(ends), counts)
        values = np.asarray(flat[ends[0] : ends[-1]])
        unit = text_attribute(flat, "units") or unit
    elif isinstance(item, h5py.Dataset) and item.ndim == 1:
        values = np.asarray(item[rows.start : rows.stop])
        same = counts is None or len(values) == len(counts)
        values = np.repeat(values, counts) if same and counts is not None else values
    else:
        raise CpunetError(f"{path}: column {name} is no array with a value per step or hit")
    if not same:
        raise CpunetError(f"{path}: columns {name} and edep differ in length; truncated?")
    return values, unit


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
    for i, axis in enumerate("xyz"):
        where = f"detector_origins/{name}/{axis}loc"
        if where in file:
            # an origin may lack a unit; all lengths of remage are in m
            unit = text_attribute(file[where], "units") or "m"
            factor = unit_factor(HitOptions(), "x", path, where, unit)
            origin[i] = file[where][()].item() * factor
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
    return columns.steps_of(options.hits_detector, options)


def csv_detectors(path: Path) -> list[str]:
    """Detectors with deposits, by their number or name; empty if no column tells them."""
    return _csv_columns(path)[1].detectors()


def _csv_columns(path: Path) -> tuple[str, Columns]:
    """Title of the file, and its columns."""
    from pandas import DataFrame, read_csv  # half a second, which other formats do not need

    with path.open(encoding="utf-8", errors="replace") as lines:
        head = list(takewhile(lambda line: line.startswith("#"), lines))
    title, names = "", []
    for line in head:
        key, _, value = line[1:].strip().partition(" ")
        if key == "title":
            title = value
        elif key == "column":
            names.append(value.partition(" ")[2])
        elif key == "separator" and value != "44":
            raise CpunetError(f"{path}: columns are not separated by commas; export again")
    try:
        # the columns of one file can be numbers, text or both
        cells: DataFrame = read_csv(
            path, header=None, skiprows=len(head), low_memory=False, encoding_errors="replace"
        )
    except ValueError as error:
        raise CpunetError(f"{path}: holds no steps ({error}); export again") from error
    if (n := cells.shape[1]) != len(names):
        raise CpunetError(f"{path}: {n} values a line for {len(names)} columns; export again")
    if cells[n - 1].isna().any():
        raise CpunetError(f"{path}: a line is not {n} values; is it cut off?")
    read = {name: in_memory(cells[at].to_numpy()) for at, name in enumerate(names)}
    return title, Columns(path, read)
