"""Tables of steps: remage, Geant4 and g4simple, archives, and our own."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import item_at, members, opened, units_of
from cpunet.pulses.reading.other_formats import read_arrays
from cpunet.pulses.reading.source import divides, dividing, labels, texts, whole_numbers
from cpunet.units import factor, unit_names

HIT_TABLE = "geds/hits"  # the hits stored with simulated pulses: one row per hit
NTUPLES, STEPS = "default_ntuples", "stp"
_G4SIMPLE, _G4SIMPLE_TITLE, _G4SIMPLE_UNITS = "g4sntuple", "steps data", "mm,MeV"
_CSV_MAGIC = b"#class tools::wcsv::ntuple"
# what a column is, and its names in small letters: the first of these is read
_NAMES = {
    "event": ("evtid", "event", "event#", "eventid", "event_id", "event_number"),
    "x": ("xloc", "x"),
    "y": ("yloc", "y"),
    "z": ("zloc", "z"),
    "edep": ("edep", "energydeposit"),
    "time": ("time", "t", "globaltime", "t0"),
}
_NEEDED = ("event", "x", "y", "z", "edep")
_VECTORS = ("cumulative_length", "flattened_data")
_WITH_UNIT = re.compile(r"(.+?)\s*(?:\[(.*)\]|_in_(.+))$")
# arrays of an NPZ, and the columns that they are
_ARRAYS = {f"{axis}_mm": f"{axis}_in_mm" for axis in "xyz"} | {"edep_keV": "edep_in_keV"}


@dataclass(frozen=True)
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
    labels: npt.NDArray[np.str_] | None = None

    def by_detector(self) -> dict[str, StepTable]:
        """The table, or its parts by the labels of their detectors where several share it.

        Labels without deposits are the world or a holder.
        """
        of = roles(self.columns)
        if missing := [role for role in _NEEDED if role not in of]:
            raise CpunetError(
                f"{self.path}: no column for {missing[0]}; "
                f"the file holds {', '.join(self.columns)}"
            )
        deposits = self._read(of["edep"][0])[0] > 0
        dividers = {name: self._read(name)[0] for name in self.columns if divides(name)}
        some = {name: values[deposits] for name, values in dividers.items()}
        names = dividing(some, int(deposits.sum())) or list(dividers)[:1]
        if not names:
            return {self.name: self}
        of_steps = texts(dividers[names[0]]) if len(names) == 1 else labels(dividers, names)
        detectors = sorted(map(str, np.unique(of_steps[deposits])), key=lambda x: (len(x), x))
        if len(detectors) > 1 or (detectors and not self.name):
            return {label: replace(self, name=label, labels=of_steps) for label in detectors}
        return {self.name: self}

    def steps(self, units: str) -> dict[str, npt.NDArray[Any]]:
        """Steps, events in any order; `units` are those of `HitOptions`.

        Returns
        -------
        dict
            ``event`` numbers, ``x``, ``y``, ``z`` (mm) from the origin of the detector, or of
            the file if it tells none, ``edep`` (keV) and, if the file has them, ``time`` (ns).

        Raises
        ------
        CpunetError
            If a column is no number or names no known unit.
        """
        chosen = slice(None) if self.labels is None else self.labels == self.name
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
                values = whole_numbers(values, where)
            else:
                given = unit or in_name, *re.split(r"[\s,]+", units), *self.units.split(",")
                values = values * _unit_factor(role, where, given)
            steps[role] = values[chosen]
            origin = f"detector_origins/{self.name}/{role}loc"
            if self.file is not None and origin in self.file:
                # it may lack a unit; all lengths of remage are in m
                item, where = self.file[origin], f"{self.path}: column {origin}"
                to_mm = _unit_factor(role, where, (units_of(item), "m"))
                steps[role] = steps[role] - item[()].item() * to_mm
        return steps

    def _read(self, name: str) -> tuple[npt.NDArray[Any], str]:
        """Values of a column for all steps, and the unit that belongs to them."""
        item, edep = self.columns[name], self.columns[roles(self.columns)["edep"][0]]
        where, vectors = f"{self.path}: column", _has(item, *_VECTORS)
        if not vectors and not (isinstance(item, h5py.Dataset | np.ndarray) and item.ndim == 1):
            raise CpunetError(f"{where} {name} is no array with a value per step or hit")
        # each row ends with one of the steps
        ends, of_edep = (
            column["cumulative_length"][()].astype(np.int64)
            if _has(column, *_VECTORS)
            else np.arange(len(column)) + 1
            for column in (item, edep)
        )
        if len(ends) != len(of_edep) or (vectors and not np.array_equal(ends, of_edep)):
            raise CpunetError(f"{where}s {name} and edep differ in length; truncated?")
        if isinstance(item, np.ndarray):
            return item, ""
        if not vectors:
            return np.repeat(item[()], np.diff(of_edep, prepend=0)), units_of(item)
        flat = item["flattened_data"]
        return np.asarray(flat[: ends.max(initial=0)]), units_of(flat) or units_of(item)


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


def _unit_factor(role: str, where: str, units: Iterable[str]) -> float:
    """Conversion factor of a column to keV, ns or mm.

    `role` is ``"edep"``, ``"time"`` or an axis. The first of the `units` is that of the column,
    ``""`` if it names none: then it is the first of the others that is of its kind. Times
    without a unit are in ns, Geant4's own.

    Raises
    ------
    CpunetError
        If the unit is unknown, or nobody tells it.
    """
    to = {"edep": "keV", "time": "ns"}.get(role, "mm")
    named, *others = units
    given = [unit for unit in (*others, "ns") if factor(unit, to)]
    if not (unit := named or next(iter(given), "")):
        raise CpunetError(f"{where} names no unit; give `units`, one of {unit_names(to)}")
    if (to_ours := factor(unit, to)) is None:
        raise CpunetError(f"{where} is in {unit!r}; expected one of {unit_names(to)}")
    return to_ours


def hit_format(path: Path) -> Literal["tables", "stored", "csv", "npz", ""]:
    """Format of a file of hits by its content; `stored` are hits with their pulses."""
    if h5py.is_hdf5(path):
        with opened(path) as file:
            if any(isinstance(file.get(folder), h5py.Group) for folder in (STEPS, NTUPLES)):
                return "tables"
            return "stored" if HIT_TABLE in file else ""
    if zipfile.is_zipfile(path):
        with suppress(zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
            return "npz" if {"x_mm.npy", "offsets.npy"} <= {*archive.namelist()} else ""
    try:
        with path.open("rb") as stream:
            return "csv" if stream.read(len(_CSV_MAGIC)) == _CSV_MAGIC else ""
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror})") from error


@contextmanager
def step_tables(path: Path) -> Iterator[dict[str, StepTable]]:
    """Open a file of hits; its tables, by detector, can be read until it is closed.

    Raises
    ------
    CpunetError
        If the file cannot be read, is of no known format or has no table of steps.
    """
    kind = hit_format(path)
    if kind in ("csv", "npz"):
        yield (_csv_table if kind == "csv" else _npz_table)(path).by_detector()
        return
    if not kind:
        raise CpunetError(
            f"{path}: no format of hits; expected LH5 or HDF5 with {STEPS} (remage), "
            f"{NTUPLES} (Geant4, g4simple) or {HIT_TABLE} (cpunet simulate), CSV or NPZ"
        )
    with opened(path) as file:
        groups = {"": file[HIT_TABLE]} if kind == "stored" else {}
        for folder in (STEPS, NTUPLES):
            if kind == "tables" and (held := item_at(file, folder)) is not None:
                groups |= members(held)
        tables: dict[str, StepTable] = {}
        for name, group in groups.items():
            if isinstance(group, h5py.Group) and {*_NEEDED} <= roles(group).keys():
                # the values of a column of Geant4's HDF5 are its pages
                columns = {
                    key: item["pages"] if _has(item, "pages") else item
                    for key, item in members(group).items()
                }
                # g4simple writes one table for all detectors
                of = ("", _G4SIMPLE_UNITS) if name == _G4SIMPLE else (name, "")
                tables |= StepTable(path, columns, *of, file).by_detector()
        if not tables:
            raise CpunetError(
                f"{path}: no table of {STEPS} or {NTUPLES} has columns for "
                f"{', '.join(_NEEDED)}; simulate again and write all steps"
            )
        yield tables


def _has(item: Any, *parts: str) -> bool:
    return isinstance(item, h5py.Group) and all(part in item for part in parts)


def _npz_table(path: Path) -> StepTable:
    """Arrays with a value per hit. Event i owns rows ``offsets[i]:offsets[i + 1]``."""
    arrays = read_arrays(path)
    needed = [*_ARRAYS, "offsets"]
    if missing := [name for name in needed if name not in arrays]:
        raise CpunetError(f"{path}: no array {missing[0]}; hits need {', '.join(needed)}")
    offsets = whole_numbers(arrays["offsets"], f"{path}: offsets")
    counts = np.diff(offsets)
    if offsets[:1].any() or np.any(counts < 0):
        raise CpunetError(f"{path}: offsets do not divide the hits into events")
    columns = {column: arrays[name] for name, column in _ARRAYS.items()}
    return StepTable(path, columns | {"event": np.repeat(np.arange(len(counts)), counts)})


def _csv_table(path: Path) -> StepTable:
    """A CSV ntuple of Geant4, or several in one file; g4simple's is recognised by its title."""
    from pandas import read_csv  # half a second, which other formats do not need

    with path.open(encoding="utf-8", errors="replace") as lines:
        headers = {n: line for n, line in enumerate(lines) if line.startswith("#")}
    first = (line for i, (n, line) in enumerate(headers.items()) if i == n)
    header = [line[1:].strip().partition(" ")[::2] for line in first]
    names = [value.partition(" ")[2] for key, value in header if key == "column"]
    about = {"title": "", "separator": str(ord(","))} | dict(header)
    how: dict[str, Any] = {"sep": chr(int(about["separator"])), "encoding_errors": "replace"}
    try:
        # the columns of one file can be numbers, text or both
        cells = read_csv(path, header=None, skiprows=[*headers], low_memory=False, **how)
    except ValueError as error:
        raise CpunetError(f"{path}: holds no steps ({error}); export again") from error
    if (n := cells.shape[1]) != len(names):
        raise CpunetError(f"{path}: {n} values a line for {len(names)} columns; export again")
    if cells[n - 1].isna().any():
        raise CpunetError(f"{path}: a line is not {n} values; is it cut off?")
    columns = {name: cells[at].to_numpy() for at, name in enumerate(names)}
    g4simple = about["title"] == _G4SIMPLE_TITLE
    return StepTable(path, columns, units=_G4SIMPLE_UNITS if g4simple else "")
