"""Read pulses from LH5 files (LEGEND's waveform tables) and from other HDF5 files."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import StoredRows, is_column, lh5_rows, opened, text_attribute
from cpunet.pulses.reading.arrays import ArraySource
from cpunet.pulses.reading.energies import Column
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.published import is_majorana, open_majorana
from cpunet.pulses.reading.source import Layout, PulseSource, Traces
from cpunet.tables import shortened

# preference among several waveform columns of a table: full record, then full-rate window
_PREFERRED = ("waveform", "waveform_windowed")
log = logging.getLogger(__name__)

_CONTACT = "chnid"  # contact of each pulse in tables of SolidStateDetectors
_PLAIN = ("waveform", "waveforms", "values")  # plain datasets, in order of preference


def open_hdf5(options: PulseFile) -> PulseSource:
    """Open the waveforms of an HDF5 file, LH5 or not; see `open_pulses`."""
    with opened(options.path) as file:
        if is_majorana(file):
            return open_majorana(options, file)
        table, _, contact = (options.table or "").partition(f"{_CONTACT}=")
        chosen = choose_waveforms(options.path, file, table)
        if chosen.is_lh5:
            return Lh5Source(options, chosen, contact)
        values = StoredRows(options.path, chosen.path, file[chosen.path].shape)
        columns = columns_of(options.path, file[chosen.table or "/"])
    return ArraySource(options, "HDF5", chosen.path, values, columns)


class Lh5Source(PulseSource):
    """An LH5 waveform table ``{t0, dt, values}``, plain or encoded, with its columns."""

    def __init__(self, options: PulseFile, chosen: WaveformColumn, contact: str = "") -> None:
        self._values = f"{chosen.path}/values"
        with opened(options.path) as file:
            columns = columns_of(options.path, file[chosen.table or "/"])
            rows = _rows_of_contact(options.path, columns, contact)
            self._first, n_pulses = rows or (0, _n_rows(file[self._values]))
            own = columns_of(options.path, file[chosen.path])
            if rows is not None:
                columns, own = (
                    {name: column.part(*rows) for name, column in of.items()}
                    for of in (columns, own)
                )
            first = self._rows(file, 0, 1, None) if n_pulses else np.empty((0, 0))
            shortest, longest = _lengths(file[self._values]) or first.shape[1:] * 2
            if shortest < longest and first.dtype.kind == "f":
                log.info(
                    f"{options.path.name}: pulses of {shortest} to {longest} samples are "
                    "continued with their last value"
                )
            layout = Layout(
                format="LH5",
                table=chosen.path,
                n_pulses=n_pulses,
                length=longest,
                columns=columns,
                period_name=f"{chosen.path}/dt",
                period=own.get("dt"),
                t0=own.get("t0"),
            )
        super().__init__(options, layout)

    def _traces(self, size: int) -> Iterator[Traces]:
        with opened(self.path) as file:
            n_pulses = self.n_pulses or 0
            for start in range(0, n_pulses, size):
                n = min(size, n_pulses - start)
                yield Traces(self._rows(file, start, n, self.length))

    def _rows(
        self, file: h5py.File, start: int, size: int, length: int | None
    ) -> npt.NDArray[Any]:
        item, start = file[self._values], self._first + start
        plain = isinstance(item, h5py.Dataset)
        values = item[start : start + size] if plain else lh5_rows(item, start, size)
        if not hasattr(values, "cumulative_length"):
            traces = np.asarray(getattr(values, "nda", values))
            if traces.ndim != 2 or traces.dtype.kind not in "iuf":
                raise CpunetError(
                    f"{file.filename}: {self._values} has values of {traces.dtype} and shape "
                    f"{traces.shape}; give a file of traces"
                )
            return traces
        lengths = np.diff(values.cumulative_length.nda.astype(np.int64), prepend=0)
        expected = int(lengths[0]) if length is None else length
        flat = np.asarray(values.flattened_data.nda)[: lengths.sum()]
        if not (other := lengths != expected).any():
            return flat.reshape(len(lengths), expected)
        first = int(other.argmax())
        if flat.dtype.kind != "f":
            raise CpunetError(
                f"{file.filename}: event {start + first}: {lengths[first]} samples, others "
                f"have {expected}",
                "split the file by length; only ideal pulses are continued with their last one",
            )
        last = np.cumsum(lengths) - 1
        at = np.minimum(np.arange(expected), lengths[:, np.newaxis] - 1)
        return np.asarray(flat[(last - lengths + 1)[:, np.newaxis] + at])


def _lengths(values: h5py.Group | h5py.Dataset) -> tuple[int, int] | None:
    """Samples of the shortest and the longest pulse, where each is as long as its drift."""
    if not isinstance(values, h5py.Group) or "cumulative_length" not in values:
        return None
    lengths = np.diff(np.asarray(values["cumulative_length"][:], np.int64), prepend=0)
    return (int(lengths.min()), int(lengths.max())) if len(lengths) else None


def _rows_of_contact(
    path: Path, columns: dict[str, Column], contact: str
) -> tuple[int, int] | None:
    """First row and number of rows of a contact, where a table holds several one by one."""
    column = columns.get(_CONTACT)
    values = column.read(0, len(column)) if column is not None else np.empty(0)
    contacts = [str(one) for one in np.unique(values)]
    if contact and contact not in contacts:
        held = ", ".join(contacts) or "none"
        raise CpunetError(f"{path}: no contact {contact} (column {_CONTACT}); it holds {held}")
    if len(contacts) < 2:
        return None
    if not contact:
        raise CpunetError(
            f"{path}: holds the pulses of contacts {', '.join(contacts)} (column {_CONTACT})",
            f"choose the one that is read out with `table` chnid={contacts[0]}",
        )
    rows = np.flatnonzero(values == type(values[0])(contact))
    if len(rows) <= rows[-1] - rows[0]:
        raise CpunetError(
            f"{path}: the rows of contacts {', '.join(contacts)} are mixed",
            "write those of a contact one after another",
        )
    return int(rows[0]), len(rows)


def _n_rows(values: h5py.Group | h5py.Dataset) -> int:
    """Number of traces; a group holds them encoded, or as vectors of their own lengths."""
    if isinstance(values, h5py.Group):
        values = values.get("encoded_data", values).get("cumulative_length")
    return int(values.shape[0]) if values is not None and values.ndim else 0


@dataclass(frozen=True)
class WaveformColumn:
    """Waveforms in a file.

    Parameters
    ----------
    table
        Path of the group that contains the waveforms and the other columns.
    name
        Name of the waveforms in it.
    is_lh5
        Whether they are an LH5 waveform table (t0, dt, values), not a plain dataset of shape
        ``(events, samples)``.
    """

    table: str
    name: str
    is_lh5: bool

    @property
    def path(self) -> str:
        """Path of the waveform column in the file."""
        return f"{self.table}/{self.name}".strip("/")


def choose_waveforms(path: Path, file: h5py.File, table: str | None) -> WaveformColumn:
    """Choose the waveforms at `table`: a table, a waveform column, or a group around one.

    Raises
    ------
    CpunetError
        If there is no such table, or not exactly one choice; the message lists the choices.
    """
    if table is None or not table.strip("/"):
        found = list(_walk(file, set()))
        if not found:
            raise _no_waveforms(path, file)
        return _only(path, found)
    item = file.get(table)
    if item is None:
        known = sorted({c.table for c in _walk(file, set())}) or _tables(file)
        raise CpunetError(f"{path}: no table {table}; there are {shortened(known)}")
    column = _column(file, table)
    if column is not None:
        return column
    found = list(_walk(item, set())) if isinstance(item, h5py.Group) else []
    if not found:
        raise CpunetError(
            f"{path}: no waveforms in {table}; "
            f"they are in {shortened(sorted({c.table for c in _walk(file, set())}))}"
        )
    return _only(path, found)


def _no_waveforms(path: Path, file: h5py.File) -> CpunetError:
    """Error that names the arrays which could be traces, if there are any."""
    arrays: list[str] = []

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        traces = isinstance(item, h5py.Dataset) and item.ndim == 2 and item.shape[1] > 3
        if traces and item.dtype.kind in "iuf":  # of three columns are positions
            arrays.append(name)

    file.visititems(look)
    if not arrays:
        return CpunetError(
            f"{path}: no waveforms in it; it holds {shortened(_tables(file))}",
            "give a file of traces (their energies may be here: `data_energy` FILE:COLUMN)",
        )
    many = "an array" if len(arrays) == 1 else f"{len(arrays)} arrays"
    return CpunetError(
        f"{path}: no table of waveforms in it, but {many} of two dimensions "
        f"({shortened(arrays)})",
        "if it holds traces, name it by `table` (`sim_table`, `data_table`); give `dt_ns`",
    )


def waveform_tables(file: h5py.File) -> list[str]:
    """Paths of the tables that contain waveforms, sorted."""
    return sorted({column.table for column in _walk(file, set())})


def _only(path: Path, found: list[WaveformColumn]) -> WaveformColumn:
    tables = sorted({column.table for column in found})
    if len(tables) > 1:
        raise CpunetError(
            f"{path}: {len(tables)} tables of waveforms ({shortened(tables)}); "
            "choose one with `table` (`sim_table`, `data_table`)"
        )
    if len(found) == 1:
        return found[0]
    by_name = {column.name: column for column in found}
    for name in _PREFERRED:
        if name in by_name:
            others = ", ".join(sorted(by_name.keys() - {name}))
            log.info(f"{path.name}: {name} is read, at the full rate, not {others} (`table`)")
            return by_name[name]
    raise CpunetError(
        f"{path}: {len(found)} waveform columns ({shortened(c.path for c in found)}); "
        "choose one with `table` (`sim_table`, `data_table`)"
    )


def _walk(group: h5py.Group, seen: set[tuple[int, int]]) -> Iterator[WaveformColumn]:
    # links can give an object several names or form cycles: visit each object once
    info = h5py.h5o.get_info(group.id)
    if (info.fileno, info.addr) in seen:
        return
    seen.add((info.fileno, info.addr))
    columns = [_column(group, name) for name in group]
    found = [column for column in columns if column is not None]
    lh5_found = [column for column in found if column.is_lh5]
    plain = [column for name in _PLAIN for column in found if column.name == name]
    yield from lh5_found or plain[:1]
    # other columns of a table can be groups of many datasets, but contain no waveforms
    if text_attribute(group, "datatype").startswith("table"):
        return
    names = {column.name for column in found}
    for name in group:
        # None for a broken link
        inner = group.get(name)
        if name not in names and isinstance(inner, h5py.Group):
            yield from _walk(inner, seen)


def _column(group: h5py.Group, name: str) -> WaveformColumn | None:
    """Return what has this name (or path) in a group as waveforms; None if it is none."""
    item = group.get(name)  # None for a broken link
    is_lh5 = isinstance(item, h5py.Group) and {"dt", "values"} <= item.keys()
    is_lh5 = is_lh5 and text_attribute(item, "datatype").startswith("table")
    plain = isinstance(item, h5py.Dataset) and item.ndim == 2 and item.dtype.kind in "iuf"
    table, _, own = f"{group.name}/{name.strip('/')}".rpartition("/")
    return WaveformColumn(table.strip("/"), own, is_lh5) if is_lh5 or plain else None


def _tables(group: h5py.Group) -> list[str]:
    """LH5 tables, or the top-level groups if there are none; for messages."""
    tables: list[str] = []

    def note(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if text_attribute(item, "datatype").startswith("table"):
            tables.append(name)

    group.visititems(note)
    return tables or list(group)


def columns_of(path: Path, group: h5py.Group) -> dict[str, Column]:
    """Columns of a group: its numeric datasets of one dimension, and its scalars."""
    members = {name: group.get(name) for name in group}
    return {name: _stored(path, m) for name, m in members.items() if is_column(m)}


def column_of(path: Path, name: str) -> tuple[Column, dict[str, Column]]:
    """Return a column of an HDF5 file by its path in the file, and all columns of its group.

    Raises
    ------
    CpunetError
        If there is no such file or column; the message lists the other columns of the group.
    """
    with opened(path) as file:
        found = file.get(name)
        if is_column(found):
            return _stored(path, found), columns_of(path, found.parent)
        parent = file.get(name.strip("/").rpartition("/")[0] or "/")
        known = list(columns_of(path, parent)) if isinstance(parent, h5py.Group) else list(file)
    raise CpunetError(f"{path}: no column {name}; there are {shortened(known)}")


def _stored(path: Path, dataset: h5py.Dataset) -> Column:
    """A dataset as a column; the file is open only while reading."""
    name, is_constant = dataset.name, dataset.ndim == 0

    def read(start: int, stop: int) -> npt.NDArray[Any]:
        with opened(path) as file:
            if is_constant:
                return np.full(stop - start, file[name][()])
            return np.asarray(file[name][start:stop])

    return Column(read, dataset.size, text_attribute(dataset, "units"), is_constant)
