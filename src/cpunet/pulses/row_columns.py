"""Columns beside the waveforms of a file, copied row by row."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import lh5
import numpy as np
from lgdo import LGDO, Array, ArrayOfEqualSizedArrays

from cpunet.hdf5_files import lh5_rows, opened, text_attribute
from cpunet.pulses.reading.energies import ENERGY_UNITS, Column

SUFFIX = "_source"  # appended to columns whose name the translation uses itself
_NUMBERS = "iufb"


@dataclass(frozen=True)
class RowColumns:
    """Columns of one table of a file, read by rows as LH5 objects.

    Parameters
    ----------
    path
        The file.
    table
        Group that holds them; not used for other formats.
    names
        Name in the file → name in the output.
    left_out
        Name of each column that cannot be copied → the reason.
    columns
        Columns that the reader of a format other than HDF5 found.
    """

    path: Path
    table: str = ""
    names: Mapping[str, str] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    columns: Mapping[str, Column] = field(default_factory=dict)

    @classmethod
    def of_hdf5(
        cls, path: Path, waveforms: str, n_pulses: int, own: Collection[str]
    ) -> RowColumns:
        """Find the columns beside the waveforms, without the waveforms themselves.

        Parameters
        ----------
        path
            LH5 or HDF5 file.
        waveforms
            Path of the waveforms in the file.
        n_pulses
            Number of rows that each column must have.
        own
            Names that the output uses itself.  A column with such a name gets `SUFFIX`, or
            is omitted if it has the same meaning (event number, energy in energy units).
        """
        table, _, chosen = waveforms.rpartition("/")
        names, left_out = list[str](), dict[str, str]()
        with opened(path) as file:
            group = file[table or "/"]
            for name in group:
                item = group.get(name)
                if name == chosen or _is_same(name, item, own):
                    continue
                if reason := _unreadable(item, n_pulses):
                    left_out[name] = reason
                else:
                    names.append(name)
        return cls(path, table or "/", _renamed(names, own), left_out)

    @classmethod
    def of_columns(
        cls, path: Path, columns: Mapping[str, Column], own: Collection[str]
    ) -> RowColumns:
        """Use the columns that the reader of another format found; names as above."""
        names = [
            name
            for name, column in columns.items()
            if not (name == "event_number" or _in_kev(name, column.units)) or name not in own
        ]
        return cls(path, names=_renamed(names, own), columns=columns)

    def read(self, start: int, n: int) -> dict[str, LGDO]:
        """The `n` rows from `start` on."""
        if not self.names:
            return {}
        if self.columns:
            found = {name: _from_column(self.columns[name], start, n) for name in self.names}
        else:
            with opened(self.path) as file:
                group = file[self.table]
                found = {name: _rows(group[name], start, n) for name in self.names}
        return {self.names[name]: column for name, column in found.items()}


def _rows(item: h5py.Group | h5py.Dataset, start: int, n: int) -> LGDO:
    if text_attribute(item, "datatype"):
        return lh5_rows(item, start, n)
    attrs = {"units": units} if (units := text_attribute(item, "units")) else {}
    if item.ndim == 0:
        return Array(np.full(n, item[()]), attrs=attrs)
    rows: Any = item[start : start + n]
    if rows.ndim > 1:
        return ArrayOfEqualSizedArrays(nda=rows, attrs=attrs)
    if rows.dtype.kind == "O":
        attrs["datatype"] = "array<1>{string}"
    return Array(rows, attrs=attrs)


def _from_column(column: Column, start: int, n: int) -> Array:
    attrs = {"units": column.units} if column.units else {}
    values = np.asarray(column.read(start, start + n))
    if values.dtype.kind == "U":
        values = np.char.encode(values, "utf-8")
    return Array(values, attrs=attrs)


def _renamed(names: Collection[str], own: Collection[str]) -> dict[str, str]:
    """Name in the output for each column: its own, or one with `SUFFIX` that is still free."""
    renamed = {name: name for name in names}
    taken = {*names, *own}
    for name in names:
        if name in own:
            while renamed[name] in taken:
                renamed[name] += SUFFIX
            taken.add(renamed[name])
    return renamed


def _is_same(name: str, item: object, own: Collection[str]) -> bool:
    """Whether a column has the same meaning as the output's column of that name."""
    if name not in own or not isinstance(item, h5py.Dataset):
        return False
    return name == "event_number" or _in_kev(name, text_attribute(item, "units"))


def _in_kev(name: str, units: str) -> bool:
    return name == "energy" and units in ENERGY_UNITS


def _unreadable(item: h5py.Group | h5py.Dataset, n_pulses: int) -> str:
    """Reason why a column cannot be copied; empty if it can."""
    if not text_attribute(item, "datatype"):
        if not isinstance(item, h5py.Dataset):
            return "a group that is no column"
        if item.dtype.kind not in _NUMBERS and not h5py.check_string_dtype(item.dtype):
            return f"of type {item.dtype}"
        rows = n_pulses if item.ndim == 0 else item.shape[0]
    else:
        try:
            rows = lh5.read_n_rows(item.name, item.file)
            _rows(item, 0, 1)
        except Exception as error:  # the library raises various errors on foreign types
            return f"the LH5 library cannot read it ({' '.join(str(error).split())})"
    return "" if rows == n_pulses else f"{rows} rows beside {n_pulses} pulses"
