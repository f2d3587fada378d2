"""Find the waveform tables of an HDF5 file, and choose one of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py

from cpunet.errors import CpunetError
from cpunet.hdf5_files import text_attribute
from cpunet.pulses.reading.columns import shortened

# preference among several waveform columns of a table: full record, then full-rate window
_PREFERRED = ("waveform", "waveform_windowed")
_PLAIN = ("waveform", "waveforms", "values")  # plain datasets, in order of preference


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
            raise CpunetError(
                f"{path}: no waveforms in it; it holds {shortened(_tables(file))}; "
                "give a file of traces (their energies may be here: --data-energy FILE:COLUMN)"
            )
        return _only(path, found)
    item = file.get(table)
    if item is None:
        known = sorted({c.table for c in _walk(file, set())}) or _tables(file)
        raise CpunetError(f"{path}: no table {table}; there are {shortened(known)}")
    column = _as_column(item)
    if column is not None:
        return column
    found = list(_walk(item, set())) if isinstance(item, h5py.Group) else []
    if not found:
        raise CpunetError(
            f"{path}: no waveforms in {table}; "
            f"they are in {shortened(sorted({c.table for c in _walk(file, set())}))}"
        )
    return _only(path, found)


def waveform_tables(file: h5py.File) -> list[str]:
    """Paths of the tables that contain waveforms, sorted."""
    return sorted({column.table for column in _walk(file, set())})


def _only(path: Path, found: list[WaveformColumn]) -> WaveformColumn:
    tables = sorted({column.table for column in found})
    if len(tables) > 1:
        raise CpunetError(
            f"{path}: {len(tables)} tables of waveforms ({shortened(tables)}); "
            "choose one with --table (--sim-table, --data-table)"
        )
    if len(found) == 1:
        return found[0]
    by_name = {column.name: column for column in found}
    for name in _PREFERRED:
        if name in by_name:
            return by_name[name]
    raise CpunetError(
        f"{path}: {len(found)} waveform columns ({shortened(c.path for c in found)}); "
        "choose one with --table (--sim-table, --data-table)"
    )


def _walk(group: h5py.Group, seen: set[tuple[int, int]]) -> Iterator[WaveformColumn]:
    # links can give an object several names or form cycles: visit each object once
    info = h5py.h5o.get_info(group.id)
    if (info.fileno, info.addr) in seen:
        return
    seen.add((info.fileno, info.addr))
    columns = [_as_column(group.get(name), group, name) for name in group]
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


def _as_column(
    item: object, parent: h5py.Group | None = None, name: str | None = None
) -> WaveformColumn | None:
    """Return an item, `name` in `parent`, as a waveform column; None if it is not one."""
    if isinstance(item, h5py.Group):
        is_lh5 = text_attribute(item, "datatype").startswith("table") and (
            "values" in item and "dt" in item
        )
        if not is_lh5:
            return None
    elif isinstance(item, h5py.Dataset):
        is_lh5 = False
        if item.ndim != 2 or item.dtype.kind not in "iuf":
            return None
    else:
        return None
    if parent is None or name is None:
        table, _, name = item.name.rpartition("/")
    else:
        table = parent.name
    return WaveformColumn(table.strip("/"), name, is_lh5)


def _tables(group: h5py.Group) -> list[str]:
    """LH5 tables, or the top-level groups if there are none; for messages."""
    tables: list[str] = []

    def note(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if text_attribute(item, "datatype").startswith("table"):
            tables.append(name)

    group.visititems(note)
    return tables or list(group)
