"""Find the tables of waveforms in an HDF5 file, and choose one of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py

from cpunet.errors import CpunetError
from cpunet.pulses.reading.columns import shortened
from cpunet.pulses.reading.hdf5 import text_attribute

# Of several waveform columns in one table: the full record, else the full-rate window.
_PREFERRED = ("waveform", "waveform_windowed")
_PLAIN = ("waveform", "waveforms", "values")


@dataclass(frozen=True)
class WaveformColumn:
    """Waveforms found in a file.

    Parameters
    ----------
    table
        Path of the group with the columns of the events.
    name
        Name of the waveform column in it.
    is_lh5
        Whether it is a waveform table (t0, dt, values) of LH5; else a plain
        dataset of two dimensions.
    """

    table: str
    name: str
    is_lh5: bool

    @property
    def path(self) -> str:
        """Path of the waveform column in the file."""
        return f"{self.table}/{self.name}".strip("/")


def choose_waveforms(path: Path, file: h5py.File, table: str | None) -> WaveformColumn:
    """The waveforms at `table` (a table, a waveform column or a group around one).

    Raises
    ------
    CpunetError
        If there are none, several, or no such table; the message lists what there is.
    """
    if table is None or not table.strip("/"):
        found = list(_walk(file, set()))
        if not found:
            raise CpunetError(
                f"{path}: no waveforms in it; it holds {shortened(_tables(file))}; "
                "give a file of traces"
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
    """Tables that hold waveforms, in the order of their names."""
    return sorted({column.table for column in _walk(file, set())})


def _only(path: Path, found: list[WaveformColumn]) -> WaveformColumn:
    tables = sorted({column.table for column in found})
    if len(tables) > 1:
        raise CpunetError(
            f"{path}: {len(tables)} tables of waveforms ({shortened(tables)}); "
            "choose one with --table"
        )
    if len(found) == 1:
        return found[0]
    by_name = {column.name: column for column in found}
    for name in _PREFERRED:
        if name in by_name:
            return by_name[name]
    raise CpunetError(
        f"{path}: {len(found)} waveform columns ({shortened(c.path for c in found)}); "
        "choose one with --table"
    )


def _walk(group: h5py.Group, seen: set[tuple[int, int]]) -> Iterator[WaveformColumn]:
    # Links may give one object several names, or lead in circles: each is met once.
    info = h5py.h5o.get_info(group.id)
    if (info.fileno, info.addr) in seen:
        return
    seen.add((info.fileno, info.addr))
    columns = [_as_column(group.get(name), group, name) for name in group]
    found = [column for column in columns if column is not None]
    lh5_found = [column for column in found if column.is_lh5]
    yield from lh5_found or [c for c in found if c.name in _PLAIN][:1]
    # A table's other columns may be groups of many datasets: no waveforms within.
    if text_attribute(group, "datatype").startswith("table"):
        return
    names = {column.name for column in found}
    for name in group:
        # A link that leads nowhere gives None.
        inner = group.get(name)
        if name not in names and isinstance(inner, h5py.Group):
            yield from _walk(inner, seen)


def _as_column(
    item: object, parent: h5py.Group | None = None, name: str | None = None
) -> WaveformColumn | None:
    """The item as waveforms, under the name by which it was reached."""
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
    """Tables of LH5, else the groups at the top; for messages."""
    tables: list[str] = []

    def note(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if text_attribute(item, "datatype").startswith("table"):
            tables.append(name)

    group.visititems(note)
    return tables or list(group)
