"""Write pulses to LH5 files, block by block, in the layout that LEGEND's software reads.

Columns of a file other than the waveforms, copied row by row.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import h5py
import lh5
import numpy as np
import numpy.typing as npt
from lgdo import LGDO, Array, ArrayOfEqualSizedArrays, Table, WaveformTable

from cpunet.errors import CpunetError
from cpunet.hdf5_files import lh5_rows, members, one_line, text_attribute, units_of
from cpunet.outputs import refuse_existing, written_aside
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.source import PulseSource
from cpunet.units import factor

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


# values and units by name, or LH5 objects
Columns = Mapping[str, tuple[npt.ArrayLike, str] | LGDO]

# Chunks of whole traces: a block of events is read without decompressing others.
_CHUNK_BYTES = 1 << 18
# Lowest gzip level: noise hardly compresses further, and it takes half the time.
_COMPRESSION = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


@dataclass(eq=False)
class PulseWriter:
    """Writer of an LH5 file: append blocks of pulses, then leave the ``with`` block.

    All blocks have the same length, sampling and columns.

    The table contains ``waveform`` (t0, dt, values; times in ns), ``energy`` (keV),
    ``event_number`` and the columns of the blocks, with the LH5 library's compression.
    The file appears only when it is complete.

    Parameters
    ----------
    path
        The file to write.
    table
        Path of the table in the file.
    waveform_units
        Units of the samples: ``"ADC"``, or ``""`` for units of the full charge.
    attrs
        Attributes of the table, such as the origin of the pulses.
    samples
        Data type of the stored samples, such as ``numpy.uint16``; the values must fit.
    force
        Whether to replace an existing file.

    Raises
    ------
    CpunetError
        If the file exists (without `force`) or cannot be written, or if no block was written.

    Examples
    --------
    >>> import tempfile
    >>> import lh5
    >>> pulses = Pulses.of(np.zeros((2, 8)), dt_ns=16, energy_kev=[1592.5, 2614.5])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with PulseWriter(Path(folder) / "pulses.lh5") as writer:
    ...         writer.append(pulses, columns={"drift_time": ([250.0, 300.0], "ns")})
    ...     lh5.read("geds/sim/drift_time", Path(folder) / "pulses.lh5").nda.tolist()
    [250.0, 300.0]
    """

    path: str | Path
    _: KW_ONLY
    table: str = "geds/sim"
    waveform_units: str = ""
    attrs: Mapping[str, str | float] | None = None
    samples: npt.DTypeLike = np.float32
    force: bool = False
    n_pulses: int = field(default=0, init=False)

    def __enter__(self) -> Self:
        refuse_existing(Path(self.path), force=self.force)
        self._stack = ExitStack()
        written = written_hdf5(Path(self.path))
        self._file, self._held = self._stack.enter_context(written)
        return self

    def __exit__(self, *error: Any) -> None:
        if error[1] is None and self.n_pulses == 0:
            with self._stack:
                raise CpunetError(f"{self.path}: no pulses to write; nothing was written")
        self._stack.__exit__(*error)

    def append(self, pulses: Pulses, columns: Columns | None = None) -> None:
        """Append a block of pulses.

        Parameters
        ----------
        pulses
            Pulses to append; an empty block adds nothing.
        columns
            Further values per event: name → (array of shape ``(n,)``, units), or an LH5 object
            of n rows.
        """
        n_rows = max(1, _CHUNK_BYTES // (4 * max(1, pulses.length)))
        settings = {"chunks": (n_rows, pulses.length), **_COMPRESSION}
        # not called "units": dspeed copies that attribute to its table buffer, which the LH5
        # library then refuses to fill a second time
        attrs = {"sample_units": self.waveform_units, "hdf5_settings": settings}
        samples = pulses.waveforms.astype(self.samples, copy=False)
        values = ArrayOfEqualSizedArrays(nda=samples, attrs=attrs)
        times = {"t0": np.array(pulses.t0_ns), "dt": np.full(len(pulses), pulses.dt_ns)}
        content: Columns = {
            "waveform": WaveformTable(**times, t0_units="ns", dt_units="ns", values=values),
            "energy": (pulses.energy_kev, "keV"),
            "event_number": (pulses.event_number, ""),
        }
        self.append_rows(self.table, {**content, **(columns or {})}, self.attrs)
        self.n_pulses += len(pulses)

    def append_rows(
        self, table: str, columns: Columns, attrs: Mapping[str, str | float] | None = None
    ) -> None:
        """Append rows to another table of the file, such as the hits of the events.

        Parameters
        ----------
        table
            Path of the table in the file, for example ``"geds/hits"``.
        columns
            Name → (array of shape ``(rows,)``, units); the same names each time.
        attrs
            Attributes of the table.
        """
        content = dict(columns)
        for name, column in columns.items():
            if not isinstance(column, LGDO):
                attrs_of = {"units": column[1]} if column[1] else {}
                content[name] = Array(np.asarray(column[0]), attrs=attrs_of)
        if len(next(iter(content.values()))) == 0:
            return
        group, _, name = table.strip("/").rpartition("/")
        rows = Table(col_dict=content, attrs=dict(attrs or {}))
        lh5.write(rows, name, self._file, group=group or "/", wo_mode="append")
        self._held.require_written()

    def annotate(self, name: str, text: str, *, file: bool = False) -> None:
        """Set an attribute of the table of pulses after the first block, or of the `file`."""
        item = self._file if file else self._file[self.table.strip("/")]
        item.attrs[name] = text


class HeldFile(io.FileIO):
    """A file that stores its first failed write and hides it from the HDF5 library.

    After a failed write the library can neither continue nor close its file: it floods the
    screen with messages and can crash at exit.
    """

    failure: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        """Write everything, unless this or an earlier write fails."""
        left = memoryview(data).cast("B")
        size = len(left)
        while len(left) and self.failure is None:
            try:
                left = left[super().write(left) :]
            except OSError as error:
                self.failure = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Change the size, unless this or an earlier call fails."""
        if self.failure is None:
            try:
                return super().truncate(size)
            except OSError as error:
                self.failure = error
        return size or 0

    def require_written(self) -> None:
        """Raise the failure, if any."""
        if self.failure is not None:
            raise self.failure


@contextmanager
def written_hdf5(target: Path) -> Iterator[tuple[h5py.File, HeldFile]]:
    """Yield an HDF5 file that is written aside, and its stream; see `written_aside`."""
    with written_aside(target) as aside, HeldFile(aside, "w+") as held:
        try:
            with h5py.File(held, "w") as file:
                yield file, held
        finally:
            held.require_written()


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
    chosen, n_rows = source.chosen, source.n_all or source.n_pulses or 0
    with one_line(source.path):
        if source.group is None:
            columns = {name: (c.values, c.units) for name, c in source.columns.items()}
            chosen, n_rows = None, source.n_pulses or 0
        else:
            waveforms = source.name.rpartition("/")[2]
            items = members(source.group)
            columns = {n: (item, units_of(item)) for n, item in items.items() if n != waveforms}
        for name, (item, units) in columns.items():
            in_kev = name == "energy" and factor(units, "keV") is not None
            same = name in own and (name == "event_number" or in_kev)
            if same and not isinstance(item, h5py.Group):
                continue
            if reason := _unreadable(item, n_rows):
                left_out[name] = reason
            else:
                readers[name] = partial(_rows, item, units, chosen)
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


def _is_lh5(item: Any) -> bool:
    return not isinstance(item, np.ndarray) and text_attribute(item, "datatype") != ""


def _rows(item: Any, units: str, chosen: npt.NDArray[Any] | None, start: int, n: int) -> LGDO:
    """Rows from a first one on, of all or of some chosen ones, which ascend."""
    some = None if chosen is None else chosen[start : start + n]
    if _is_lh5(item):
        return lh5_rows(item, 0 if some is not None else start, n, some)
    attrs = {"units": units} if units else {}
    if item.ndim == 0:
        return Array(np.full(n, item[()]), attrs=attrs)
    part = slice(start, start + n) if some is None else slice(some[0], some[-1] + 1)
    rows: Any = item[part] if some is None else item[part][some - some[0]]
    if rows.ndim > 1:
        return ArrayOfEqualSizedArrays(nda=rows, attrs=attrs)
    if rows.dtype.kind == "O":
        attrs["datatype"] = "array<1>{string}"
    return Array(rows, attrs=attrs)


def _unreadable(item: Any, n_pulses: int) -> str:
    """Reason why a column cannot be copied; empty if it can."""
    if _is_lh5(item):
        try:
            rows = lh5.read_n_rows(item.name, item.file)
            _rows(item, "", None, 0, 1)
        except Exception as error:  # the library raises various errors on foreign types
            return f"the LH5 library cannot read it ({' '.join(str(error).split())})"
    elif isinstance(item, h5py.Group):
        return "a group that is no column"
    elif item.dtype.kind not in _NUMBERS and not h5py.check_string_dtype(item.dtype):
        return f"of type {item.dtype}"
    else:
        rows = n_pulses if item.ndim == 0 else item.shape[0]
    return "" if rows == n_pulses else f"{rows} rows for {n_pulses} pulses"
