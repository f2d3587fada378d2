"""Files of pulses of any format, open: their traces and columns, and pulses in blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.division import divides, dividing, labels, texts
from cpunet.pulses.reading.energies import (
    EVENT_KEYS,
    TOLERANCE,
    Column,
    require_length,
    resolve_energies,
    resolve_sampling,
    some_of,
)
from cpunet.pulses.reading.files import PulseFile
from cpunet.tables import shortened
from cpunet.units import factor

if TYPE_CHECKING:  # of a library that other formats do not need
    import h5py

    from cpunet.hdf5_files import Read

BLOCK_BYTES = 1 << 28  # maximum size of a block of float32 traces
ANY = "*"  # value of a column that separates no channels
_MAX_NUMBER = 2.0**62
_EVENT_NUMBERS = EVENT_KEYS[:-1]


@dataclass(frozen=True, eq=False)
class RawTable:
    """Traces of one channel, open for reading, as the reader of a format gives them.

    Parameters
    ----------
    format
        Name of the format.
    name
        Location of the traces in the file.
    n
        Number of traces; None if it is unknown without reading the whole file.
    length
        Samples per trace.
    rows
        Gives the traces from a first one to the one before a last, shape ``(n, samples)``; of
        a file with fewer those that are left.
    columns
        Columns with one value per trace, by name.
    attrs
        What the file says about the traces: side, maker, detector.
    period_name
        Name of the column of the sampling period.
    period
        Sampling period, if it is in the file.
    period_hint
        Hint for the error message if the sampling period is not in the file.
    t0
        Times of the first samples, if they are in the file.
    numbers
        Event numbers of the traces read last, if they are in no column.
    group, close
        Group of an HDF5 file with columns of any kind; closes the file.
    chosen, n_all
        Rows of the table that are read, and how many it has; None if all are.
    """

    format: str
    name: str
    n: int | None
    length: int
    rows: Read
    columns: Mapping[str, Column] = field(default_factory=dict)
    attrs: Mapping[str, str] = field(default_factory=dict)
    period_name: str = "dt"
    period: Column | None = None
    period_hint: str = ""
    t0: Column | None = None
    numbers: Read | None = None
    group: h5py.Group | None = None
    close: Callable[[], None] = lambda: None
    chosen: npt.NDArray[np.int64] | None = None
    n_all: int | None = None

    @classmethod
    def of_array(
        cls,
        path: Path,
        format: str,
        name: str,
        values: Any,
        columns: Mapping[str, Column],
        attrs: Mapping[str, str] = MappingProxyType({}),
        period_hint: str = "",
    ) -> RawTable:
        """An array, in memory or stored, of shape ``(traces, samples)``, and its columns.

        Raises
        ------
        CpunetError
            If the columns have a value for each of its samples: Julia and MATLAB write arrays
            with their dimensions reversed.
        """
        n, length = values.shape
        sizes = {len(column) for column in columns.values() if not column.constant}
        if length in sizes and n not in sizes:
            raise CpunetError(
                f"{path}: traces of shape {values.shape} beside columns of {length}: their "
                "dimensions are reversed",
                "write them transposed, with the pulses first",
            )
        period_name = "dt_ns" if "dt_ns" in columns else "dt"
        return cls(
            format, name, n, length, lambda start, stop: values[start:stop], columns, attrs,
            period_name, columns.get(period_name), period_hint,
        )  # fmt: skip

    def of_channel(self, path: Path, chosen: Mapping[str, str]) -> RawTable:
        """Rows with the chosen values of some columns, or all if they are of one channel.

        Raises
        ------
        CpunetError
            If there are none, or they are of several channels.
        """
        if self.n is None or self.chosen is not None:
            return self
        whole = {n: c for n, c in self.columns.items() if len(c) == self.n}
        rows = np.arange(self.n)
        for name, value in chosen.items():
            if value == ANY:
                continue
            if name not in whole:
                raise CpunetError(f"{path}: no column {name}; there are {shortened(whole)}")
            there = texts(whole[name].read(0, self.n))
            rows = rows[there[rows] == value]
            if not len(rows):
                raise CpunetError(
                    f"{path}: no {name} {value}; it holds {shortened(np.unique(there))}"
                )
        of = {n: c.read(0, self.n)[rows] for n, c in whole.items() if divides(n)}
        of = {name: values for name, values in of.items() if name not in chosen}
        if names := dividing(of, len(rows)):
            held = list(np.unique(labels(of, names)))
            also = ", or all for each" if self.format in ("LH5", "HDF5") else ""
            raise CpunetError(
                f"{path}: one table of {len(held)} channels or detectors ({shortened(held)})",
                f"choose one with `table` {held[0]} (`sim_table`, `data_table`){also}; "
                f"{','.join(f'{name}={ANY}' for name in names)} takes them as one",
            )
        return self if len(rows) == self.n else self.at(rows)

    def at(self, rows: npt.NDArray[np.int64]) -> RawTable:
        """Some rows, which ascend."""
        period, t0 = (c and c.at(rows) for c in (self.period, self.t0))
        return replace(
            self, n=len(rows), rows=partial(some_of, self.rows, rows), period=period, t0=t0,
            columns={n: c.at(rows) for n, c in self.columns.items()},
            chosen=rows, n_all=self.n,
        )  # fmt: skip


def choose_table(
    options: PulseFile,
    known: list[str],
    one: str,
    many: str,
    remedy: str = "choose one with `table` (`sim_table`, `data_table`)",
) -> str:
    """The table that the user chose, or the only one.

    Parameters
    ----------
    options
        The file and what was chosen.
    known
        Tables in the file, at least one.
    one, many
        What a table and several are called.
    remedy
        What to do if nothing was chosen.

    Raises
    ------
    CpunetError
        If there is no such table, or there are several and none was chosen.
    """
    if options.place is None:
        if len(known) == 1:
            return known[0]
        raise CpunetError(f"{options.path}: {len(known)} {many} ({shortened(known)}); {remedy}")
    if options.place not in known:
        raise CpunetError(
            f"{options.path}: no {one} {options.place}; there are {shortened(known)}"
        )
    return options.place


class PulseSource:
    """Pulses of an open file: iterate over its `blocks`, or `read` it as a whole.

    The file is closed at the end of a ``with``, or with the last reference to this.  The memory
    in use does not grow with the file, except for ``.npz`` and pickles, which are read as a
    whole.

    Attributes
    ----------
    path : pathlib.Path
        The file.
    dt_ns : float
        Sampling period in ns.
    n_pulses : int or None
        Number of pulses; None if it is unknown without reading the whole file.
    length : int
        Samples per pulse.
    table : RawTable
        Content of the file.
    energies : Energies
        Rule that gives each pulse its energy.
    """

    def __init__(self, options: PulseFile, table: RawTable) -> None:
        if table.n == 0 or table.length == 0:
            raise CpunetError(
                f"{options.path}: {table.name or table.format} holds no pulses; "
                "give a file with events"
            )
        table = table.of_channel(options.path, options.rows)
        self.path = options.path
        self.n_pulses = table.n
        self.length = table.length
        self.table = table
        self.dt_ns, self._periods = resolve_sampling(options, table)
        self.energies = resolve_energies(options, table)
        self._number_column = next((n for n in _EVENT_NUMBERS if n in table.columns), None)
        if self._number_column is not None:
            column = table.columns[self._number_column]
            require_length(options.path, self._number_column, column, table.n)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.table.close()

    def blocks(self, size: int = 4096) -> Iterator[Pulses]:
        """Yield the pulses of the file in order, at most `size` at a time.

        Blocks of long traces are smaller, so that none exceeds `BLOCK_BYTES`.

        Raises
        ------
        CpunetError
            If the file is damaged or contains no pulses, or if its events differ in length or
            sampling period.
        """
        size, start = min(size, max(1, BLOCK_BYTES // (4 * self.length))), 0
        while start != self.n_pulses:
            waveforms = self.table.rows(start, start + size)
            if not len(waveforms):
                break
            yield self._pulses(start, waveforms)
            start += len(waveforms)
        if start == 0:
            raise CpunetError(f"{self.path}: holds no pulses; give a file with events")
        column = self.energies.column
        if column is not None and not column.constant and len(column) != start:
            raise CpunetError(
                f"{self.path}: {start} waveforms, but {len(column)} energies; "
                "give the energies of the same events"
            )

    def read(self, start: int = 0, stop: int | None = None) -> Pulses:
        """Read all pulses of the file, or some rows, at once; they must fit in memory."""
        if stop is None:
            return Pulses.concatenate(list(self.blocks()))
        return self._pulses(start, self.table.rows(start, stop))

    @property
    def columns(self) -> Mapping[str, Column]:
        """Columns with one value per event, by name."""
        return self.table.columns

    def _pulses(self, start: int, traces: npt.NDArray[Any]) -> Pulses:
        with np.errstate(over="ignore"):  # samples beyond the range of float32 become infinite
            waveforms = np.asarray(traces, np.float32)
        stop = start + len(waveforms)
        numbers = np.arange(start, stop)
        if self._number_column is not None:
            numbers = self.columns[self._number_column].read(start, stop)
        elif self.table.numbers is not None:
            numbers = self.table.numbers(start, stop)
        energy_kev = self.energies.of(start, waveforms)
        if len(energy_kev) != len(waveforms):
            raise CpunetError(
                f"{self.path}: event {numbers[len(energy_kev)]} has no energy; "
                "give the energies of the same events"
            )
        event_number = whole_numbers(np.asarray(numbers), f"{self.path}: event_number", start)
        if self._periods is not None:
            periods = self._periods(start, stop)
            other = ~np.isclose(periods, self.dt_ns, rtol=TOLERANCE, atol=0)
            if other.any():
                first = int(other.argmax())
                raise CpunetError(
                    f"{self.path}: event {event_number[first]}: sampling period "
                    f"{periods[first]:g} ns, before it {self.dt_ns:g} ns; "
                    "split the file by sampling period"
                )
        t0, t0_ns = self.table.t0, np.zeros(len(waveforms))
        if t0 is not None and (ns_per_unit := factor(t0.units, "ns")) is not None:
            t0_ns = ns_per_unit * np.asarray(t0.read(start, stop), np.float64)
        return Pulses.of(
            waveforms,
            dt_ns=self.dt_ns,
            energy_kev=energy_kev,
            event_number=event_number,
            t0_ns=t0_ns,
        )


def whole_numbers(
    values: npt.NDArray[Any], where: str, start: int = 0
) -> npt.NDArray[np.int64]:
    """Numbers of events as integers; some files store them as floating-point numbers.

    Parameters
    ----------
    values
        A number for each row.
    where
        File and column, for the message.
    start
        Row of the first number.

    Raises
    ------
    CpunetError
        If one is no whole number or too large.
    """
    if values.dtype.kind != "i":
        numbers = (
            values.astype(float) if values.dtype.kind in "uf" else np.full(len(values), np.nan)
        )
        bad = ~((numbers == np.rint(numbers)) & (np.abs(numbers) < _MAX_NUMBER))
        if bad.any():
            row = int(bad.argmax())
            raise CpunetError(
                f"{where}: row {start + row}: {values[row]} is no number of an event; number "
                "the events anew"
            )
    return values.astype(np.int64)
