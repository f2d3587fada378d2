"""Columns of a file other than the waveforms, copied row by row."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any, TypeAlias

import h5py
import lh5
import numpy as np
import numpy.typing as npt
from lgdo import LGDO, Array, ArrayOfEqualSizedArrays

from cpunet.hdf5_files import lh5_rows, members, one_line, text_attribute, units_of
from cpunet.pulses.reading.columns import Column
from cpunet.pulses.reading.source import PulseSource
from cpunet.units import factor

SUFFIX = "_source"  # appended to columns whose name the translation uses itself
_NUMBERS = "iufb"

Read: TypeAlias = Callable[[int, int], dict[str, LGDO]]  # from a row on, so many rows


def other_columns(source: PulseSource, own: Collection[str]) -> tuple[Read, dict[str, str]]:
    """Columns of a file other than the waveforms.

    Parameters
    ----------
    source
        The file.
    own
        Names that the output uses itself.  A column with such a name gets `SUFFIX`, or is
        omitted if it has the same meaning (event number, energy in energy units).

    Returns
    -------
    read
        Reads rows of all columns as LH5 objects, by name in the output.
    left_out
        The reason for each column that cannot be copied.
    """
    readers, left_out = dict[str, Callable[[int, int], LGDO]](), dict[str, str]()
    if (group := source.group) is None:
        for name, column in source.columns.items():
            if not _is_same(name, column.units, own):
                readers[name] = partial(_from_column, column)
    else:
        waveforms, size = source.name.rpartition("/")[2], source.n_all or source.n_pulses or 0
        with one_line(source.path):
            for name, item in members(group).items():
                is_plain = isinstance(item, h5py.Dataset)
                units = units_of(item) if is_plain else ""
                if name == waveforms or (is_plain and _is_same(name, units, own)):
                    continue
                if reason := _unreadable(item, size):
                    left_out[name] = reason
                else:
                    readers[name] = partial(_rows, group[name], source.chosen)
    shown, taken = {}, {*readers, *own}
    for name in readers:
        shown[name] = name
        while name in own and shown[name] in taken:
            shown[name] += SUFFIX
        taken.add(shown[name])

    def read(start: int, n: int) -> dict[str, LGDO]:
        with one_line(source.path):
            return {shown[name]: reader(start, n) for name, reader in readers.items()}

    return read, left_out


def _rows(
    item: h5py.Group | h5py.Dataset, chosen: npt.NDArray[Any] | None, start: int, n: int
) -> LGDO:
    """Rows from a first one on, of all or of some chosen ones, which ascend."""
    some = None if chosen is None else chosen[start : start + n]
    if text_attribute(item, "datatype"):
        return lh5_rows(item, 0 if some is not None else start, n, some)
    attrs = {"units": units} if (units := units_of(item)) else {}
    if item.ndim == 0:
        return Array(np.full(n, item[()]), attrs=attrs)
    part = slice(start, start + n) if some is None else slice(some[0], some[-1] + 1)
    rows: Any = item[part] if some is None else item[part][some - some[0]]
    if rows.ndim > 1:
        return ArrayOfEqualSizedArrays(nda=rows, attrs=attrs)
    if rows.dtype.kind == "O":
        attrs["datatype"] = "array<1>{string}"
    return Array(rows, attrs=attrs)


def _from_column(column: Column, start: int, n: int) -> Array:
    attrs = {"units": column.units} if column.units else {}
    return Array(np.asarray(column.read(start, start + n)), attrs=attrs)


def _is_same(name: str, units: str, own: Collection[str]) -> bool:
    """Whether a column has the same meaning as the output's column of that name."""
    in_energy_units = name == "energy" and factor(units, "keV") is not None
    return name in own and (name == "event_number" or in_energy_units)


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
            _rows(item, None, 0, 1)
        except Exception as error:  # the library raises various errors on foreign types
            return f"the LH5 library cannot read it ({' '.join(str(error).split())})"
    return "" if rows == n_pulses else f"{rows} rows for {n_pulses} pulses"
