"""Read pulses from LH5 files (LEGEND's waveform tables) and from other HDF5 files.

The release of the Majorana Demonstrator for machine learning is such a file (Table I of its
notes, arXiv:2308.10856; 10.5281/zenodo.8257027): datasets with a row for each event, named
``raw_waveform``, ``energy_label`` (keV), ``detector`` and others, without a sampling period.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, TypeGuard

import h5py
import numpy as np
import numpy.typing as npt

from cpunet import hdf5_files as h5
from cpunet.errors import CpunetError
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import EVENT_KEYS, Column, PulseSource, divides, parts
from cpunet.tables import shortened

# preference among several waveform columns of a table: full record, then full-rate window
_PREFERRED = ("waveform", "waveform_windowed")
log = logging.getLogger(__name__)

Item: TypeAlias = h5py.Group | h5py.Dataset
_Folder = tuple[str, dict[str, Item], list[str], list[str]]

# plain datasets, in order of preference
_PLAIN = ("waveform", "waveforms", "values", "raw_waveform")


def read_hdf5(options: PulseFile) -> PulseSource:
    """The waveforms of an HDF5 file, LH5 or not; see `open_pulses`."""
    path, file = options.path, h5.open_hdf5(options.path)
    with h5.one_line(path):
        name = choose_waveforms(path, file, options.place)
        table, _, own_name = name.rpartition("/")
        group, values, times = file[table or "/"], file[name], dict[str, Column]()
        columns = columns_of(path, group)
        attrs = {n: h5.text_attribute(item, n) for item in (file, group) for n in item.attrs}
        if is_lh5 := isinstance(values, h5py.Group):
            times, values = columns_of(path, values), values["values"]
        else:
            columns.pop(own_name, None)  # one pulse is a row, as MATLAB writes a vector
        # a group holds the traces encoded, or as vectors of their own lengths
        sized = values
        if isinstance(values, h5py.Group):
            sized = values.get("encoded_data", values).get("cumulative_length")
        n = int(sized.shape[0]) if sized is not None and sized.ndim else 0
        first = _traces(values, None, 0, 1) if n else np.empty((0, 0))
        length = first.shape[1]
        own = n and isinstance(values, h5py.Group) and "cumulative_length" in values
        if own and first.dtype.kind == "f":
            lengths = np.diff(np.asarray(sized[:], np.int64), prepend=0)
            length = int(lengths.max())
            if lengths.min() < length:
                span = f"{lengths.min()} to {length} samples"
                log.info(f"{path.name}: pulses of {span} are continued with their last value")

        def rows(start: int, stop: int) -> npt.NDArray[Any]:
            with h5.one_line(path):
                return _traces(values, length, start, stop)

        return PulseSource(
            path, "LH5" if is_lh5 else "HDF5", name, n, length, rows, columns, times, attrs,
            group=group, close=file.close,
        )  # fmt: skip


def _traces(item: Item, length: int | None, start: int, stop: int) -> npt.NDArray[Any]:
    """Rows of traces; vectors of their own lengths are continued to `length` samples."""
    plain = isinstance(item, h5py.Dataset)
    values = item[start:stop] if plain else h5.lh5_rows(item, start, stop - start)
    if not hasattr(values, "cumulative_length"):
        traces = np.asarray(getattr(values, "nda", values))
        if traces.ndim != 2 or traces.dtype.kind not in "iuf":
            raise CpunetError(
                f"{item.file.filename}: {item.name.strip('/')} has values of {traces.dtype} "
                f"and shape {traces.shape}; give a file of traces"
            )
        return traces
    lengths = np.diff(values.cumulative_length.nda.astype(np.int64), prepend=0)
    expected = int(lengths[0]) if length is None else length
    flat = np.asarray(values.flattened_data.nda)[: lengths.sum()]
    other = lengths != expected
    if other.any() and flat.dtype.kind != "f":
        first = int(other.argmax())
        raise CpunetError(
            f"{item.file.filename}: event {start + first}: {lengths[first]} samples, others "
            f"have {expected}",
            "split the file by length; only ideal pulses are continued with their last one",
        )
    begins = np.cumsum(lengths) - lengths
    at = np.minimum(np.arange(expected), lengths[:, np.newaxis] - 1)
    return np.asarray(flat[begins[:, np.newaxis] + at])


def choose_waveforms(path: Path, file: h5py.File, table: str | None) -> str:
    """Path of the waveforms at `table`: a table, a waveform column, or a group around one.

    Raises
    ------
    CpunetError
        If there is no such table, or not exactly one choice; the message lists the choices.
    """
    place = (table or "").strip("/")
    item = h5.item_at(file, place)
    if item is None:
        tables = waveform_tables(file) or list(file)
        raise CpunetError(f"{path}: no table {place}; there are {shortened(tables)}")
    if _is_lh5(item) or _is_array(item):
        return place
    folders = [*_folders(item, place)] if isinstance(item, h5py.Group) else []
    for *_, broken in folders:
        for link in broken:
            h5.item_at(file, link)  # which says what is wrong
    columns = [column for _, _, waveforms, _ in folders for column in waveforms]
    if len(columns) == 1:
        return columns[0]
    if not columns:
        raise _no_waveforms(path, file, place)
    tables = sorted({column.rpartition("/")[0] for column in columns})
    names = {column.rpartition("/")[2]: column for column in columns}
    best = next((name for name in _PREFERRED if name in names), None)
    if len(tables) > 1 or best is None:
        several = tables if len(tables) > 1 else columns
        what = "tables of waveforms" if len(tables) > 1 else "waveform columns"
        raise CpunetError(
            f"{path}: {len(several)} {what} ({shortened(several)}); choose one with `table` "
            "(`sim_table`, `data_table`)"
        )
    others = ", ".join(sorted(names.keys() - {best}))
    log.info(f"{path.name}: {best} is read, at the full rate, not {others} (`table`)")
    return names[best]


def _no_waveforms(path: Path, file: h5py.File, place: str) -> CpunetError:
    """Error that names what could be traces: the arrays with most values for each event."""
    if place and (tables := waveform_tables(file)):
        return CpunetError(f"{path}: no waveforms in {place}; they are in {shortened(tables)}")
    held: dict[str, int] = {}
    for folder, items, _, _ in _folders(file):
        for name, item in items.items():
            if isinstance(item, h5py.Dataset) and item.shape:
                what = h5py.check_vlen_dtype(item.dtype) or item.dtype
                size = item.dtype.itemsize * int(np.prod(item.shape[1:]))
                held[f"{folder}/{name}".strip("/") + f" {item.shape} of {what}"] = size
    listed = sorted(held, key=lambda name: -held[name]) or list(file)
    return CpunetError(
        f"{path}: no waveforms in it; it holds {shortened(listed)}",
        "name an array of traces (event, sample) by `table` (`sim_table`, `data_table`) and "
        "give `dt_ns`, or write them as such an array; energies are `data_energy` FILE:COLUMN",
    )


def _is_array(item: object) -> TypeGuard[h5py.Dataset]:
    return isinstance(item, h5py.Dataset) and item.ndim == 2 and item.dtype.kind in "iuf"


def waveform_tables(file: h5py.File) -> list[str]:
    """Paths of the tables that contain waveforms, sorted, and of links that lead nowhere."""
    places = [lost or ([path] if held else []) for path, _, held, lost in _folders(file)]
    return sorted({place for some in places for place in some})


def channel_tables(path: Path) -> list[str]:
    """The same of a file, with the rows of each channel where one table holds several."""
    channels: list[str] = []
    with h5.opened(path) as file:
        for table in waveform_tables(file):
            try:
                columns = columns_of(path, h5.item_at(file, table))
            except CpunetError:  # said where the table is opened
                columns = {}
            n = max((column.size for column in columns.values()), default=0)
            whole = {name: column for name, column in columns.items() if column.size == n}
            names = parts(whole, np.arange(n))[1] or [""]
            channels += [f"{table}/{name}".strip("/") for name in names]
    return channels


def _folders(
    group: h5py.Group, path: str = "", seen: set[tuple[int, int]] | None = None
) -> Iterator[_Folder]:
    """A group and those in it, except in tables, through links.

    Of each: its path, what it holds, paths of waveforms in it, and of links that lead nowhere.
    The waveforms are those of LH5, or else the first of the usual names.
    """
    # links can give an object several names or form cycles: visit each object once
    seen, info = set() if seen is None else seen, h5py.h5o.get_info(group.id)
    if (info.fileno, info.addr) in seen:
        return
    seen.add((info.fileno, info.addr))
    items, broken = dict[str, Item](), list[str]()
    for name in group:
        try:
            items[name] = h5.item_at(group, name)
        except CpunetError:
            broken.append(name)
    is_table = h5.text_attribute(group, "datatype").startswith("table")
    names = [name for name, item in items.items() if _is_lh5(item)]
    names = names or [name for name in _PLAIN if _is_array(items.get(name))][:1]
    if is_table and {"dt", "values"} <= items.keys():
        names = []  # the inside of waveforms
    of = f"{path}/".lstrip("/")
    lost = [] if names or is_table else [of + name for name in broken]
    yield path, items, [of + name for name in names], lost
    for name, item in items.items():
        # columns of a table can be groups of many datasets, but contain no waveforms
        if isinstance(item, h5py.Group) and not is_table:
            yield from _folders(item, of + name, seen)


def _is_lh5(item: object) -> bool:
    """Whether an item is an LH5 waveform table (t0, dt, values)."""
    is_group = isinstance(item, h5py.Group) and {"dt", "values"} <= item.keys()
    return is_group and h5.text_attribute(item, "datatype").startswith("table")


def columns_of(path: Path, group: h5py.Group) -> dict[str, Column]:
    """Columns of a group: its numbers, and texts where they separate channels."""

    def load(item: h5py.Dataset) -> npt.NDArray[Any]:
        with h5.one_line(path):
            values = np.asarray(item[()])
        return values.ravel() if values.ndim else values

    columns = {}
    for name, item in h5.members(group).items():
        # MATLAB has no vectors, but writes a row
        is_number = h5.is_column(item) or (_is_array(item) and 1 in item.shape)
        is_text = isinstance(item, h5py.Dataset) and item.ndim == 1 and item.dtype.kind in "SO"
        if is_number or (is_text and divides(name)):
            columns[name] = Column(partial(load, item), item.size, h5.units_of(item))
    return columns


def column_elsewhere(source: PulseSource, column: str) -> Column:
    """``FILE:path/to/column`` in the order of the pulses, if both tell of which events.

    Raises
    ------
    CpunetError
        If there is no such file or column, or it is of other events.
    """
    path, place = Path(column.rpartition(":")[0]), column.rpartition(":")[2].strip("/")
    folder, _, own = place.rpartition("/")
    file = h5.open_hdf5(path)
    with h5.one_line(path):
        group = h5.item_at(file, folder)
        columns = columns_of(path, group) if isinstance(group, h5py.Group) else {}
        names = list(columns or file)
    if own not in columns:
        raise CpunetError(f"{path}: no column {place}; there are {shortened(names)}")
    if source.chosen is not None and columns[own].size == source.n_all:
        columns = {name: c.at(source.chosen, source.n_all) for name, c in columns.items()}
    theirs, wanted = columns[own], source.columns
    key = next((k for k in EVENT_KEYS if k in wanted and k in columns), None)
    if key is None or not wanted[key].values.ndim or columns[key].size != theirs.size:
        return theirs
    events, others = wanted[key].values, columns[key].values
    if np.array_equal(events, others):
        return theirs
    _, at, of = np.intersect1d(events, others, return_indices=True)
    if not len(at) or any(len(np.unique(keys)) < len(keys) for keys in (events, others)):
        text = f"{source.path}: {column} is of other events than these pulses ({key})"
        raise CpunetError(text, "give the energies of the same events")
    log.info(
        f"{source.path.name}: {column} is in another order or of other events; joined by "
        f"{key}, {len(events) - len(at)} of {len(events)} pulses have no energy there"
    )
    values = np.full(len(events), np.nan)
    values[at] = np.asarray(theirs.values, float)[of]
    return Column.of(values, theirs.units)
