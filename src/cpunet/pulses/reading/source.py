"""A file of pulses of any format, open: its traces and columns, and pulses in blocks."""

from __future__ import annotations

import logging
import re
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
from cpunet.pulses.reading.columns import (
    Column,
    divides,
    dividing,
    labels,
    some_of,
    texts,
    whole_numbers,
)
from cpunet.tables import shortened
from cpunet.units import factor, unit_names

if TYPE_CHECKING:  # of libraries that other formats do not need
    import h5py

    from cpunet.hdf5_files import Read
    from cpunet.pulses.reading.files import PulseFile

log = logging.getLogger(__name__)

BLOCK_BYTES = 1 << 28  # maximum size of a block of float32 traces
ANY = "*"  # value of a column that separates no channels

# Columns by which the rows of two files are joined; the last is no number of an event.
EVENT_KEYS = ("event_number", "eventnumber", "evtid", "ievt", "timestamp")
_USUAL = ("energy_kev", "energy_keV", "energy", "energy_label")
# LEGEND's hit tier calls calibrated energies `cuspEmax_ctc_cal` and gives them no units, the
# release of the Majorana Demonstrator `energy_label`.
_NAMED_IN_KEV = re.compile(r"(_cal|kev|energy_label)$", re.IGNORECASE)

# The first samples of a trace, before any pulse, for the amplitude's baseline.
_BASELINE_FRACTION, _BASELINE_SAMPLES = 0.05, 10
TOLERANCE = 1e-5  # relative, of periods, which files store in single precision


def amplitude(waveforms: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Maximum above the mean of the first twentieth (at least 10 samples), per trace.

    Examples
    --------
    >>> amplitude(np.repeat(np.array([[3, 8]], np.float32), 50, axis=1))
    array([5.])
    """
    n_baseline = max(_BASELINE_SAMPLES, round(_BASELINE_FRACTION * waveforms.shape[1]))
    # A trace of infinities has no amplitude; the preparation rejects and counts it.
    with np.errstate(invalid="ignore"):
        baseline = waveforms[:, :n_baseline].mean(axis=1, dtype=np.float64)
        return np.asarray(waveforms.max(axis=1) - baseline)


@dataclass(frozen=True, eq=False, repr=False)
class PulseSource:
    """Pulses of an open file: iterate over its `blocks`, or `read` it as a whole.

    The reader of a format gives the content, and `resolved` the sampling period and the
    energies.  The file is closed at the end of a ``with``, or with the last reference to this.
    The memory in use does not grow with the file, except for ``.npz`` and pickles, which are
    read as a whole.

    Parameters
    ----------
    path, format
        The file, and the name of its format.
    name
        Location of the traces in the file.
    n_pulses
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
    t0
        Times of the first samples, if they are in the file.
    numbers
        Gives the event numbers of the traces read last, if the file has any.
    group, close
        Group of an HDF5 file with columns of any kind; closes the file.
    chosen, n_all
        Rows of the table that are read, and how many it has; None if all are.
    dt_ns
        Sampling period in ns; then `period` is that of each trace in ns, or None.
    energies
        The rule that gives each pulse its energy, in words.
    energy, kev_per_adc
        Energies in keV; without them, the factor from the amplitude, or unknown without that.
    """

    path: Path
    format: str
    name: str
    n_pulses: int | None
    length: int
    rows: Read
    columns: Mapping[str, Column] = field(default_factory=dict)
    attrs: Mapping[str, str] = field(default_factory=dict)
    period_name: str = "dt"
    period: Column | None = None
    t0: Column | None = None
    numbers: Read | None = None
    group: h5py.Group | None = None
    close: Callable[[], None] = lambda: None
    chosen: npt.NDArray[np.int64] | None = None
    n_all: int | None = None
    dt_ns: float = np.nan
    energies: str = ""
    energy: Column | None = None
    kev_per_adc: float | None = None

    @classmethod
    def of_array(
        cls,
        path: Path,
        format: str,
        name: str,
        values: Any,
        columns: Mapping[str, Column],
        attrs: Mapping[str, str] = MappingProxyType({}),
    ) -> PulseSource:
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
                f"{path}: traces of shape {values.shape} with columns of {length}: their "
                "dimensions are reversed",
                "write them transposed, with the pulses first",
            )
        period_name, period = "dt", columns.get("dt")
        if (in_ns := columns.get("dt_ns")) is not None:
            period_name, period = "dt_ns", replace(in_ns, units=in_ns.units or "ns")
        return cls(
            path, format, name, n, length, lambda start, stop: values[start:stop], columns,
            attrs, period_name, period,
        )  # fmt: skip

    def at(self, rows: npt.NDArray[np.int64]) -> PulseSource:
        """Some rows, which ascend."""
        period, t0 = (c and c.at(rows) for c in (self.period, self.t0))
        return replace(
            self, n_pulses=len(rows), rows=partial(some_of, self.rows, rows), period=period,
            t0=t0, columns={n: c.at(rows) for n, c in self.columns.items()},
            chosen=rows, n_all=self.n_pulses,
        )  # fmt: skip

    def resolved(self, file: PulseFile) -> PulseSource:
        """With the rows, the sampling period and the energies that the user chose.

        Raises
        ------
        CpunetError
            If it holds no pulses, or those of several channels, or the options do not fit.
        """
        if self.n_pulses == 0 or self.length == 0:
            raise CpunetError(
                f"{self.path}: {self.name or self.format} holds no pulses; "
                "give a file with events"
            )
        of_channel = self._of_channel(file.rows)
        columns, t0, numbers = of_channel.columns, of_channel.t0, of_channel.numbers
        dt_ns, period = _sampling(of_channel, file.dt_ns)
        energies, energy = _energies(of_channel, file.energy, file.kev_per_adc)
        if name := next((name for name in EVENT_KEYS[:-1] if name in columns), None):
            columns[name].require_length(self.path, name, of_channel.n_pulses)
            numbers = columns[name].read
        return replace(
            of_channel, dt_ns=dt_ns, period=period, t0=None if t0 is None else t0.to("ns"),
            numbers=numbers, energies=energies, energy=energy, kev_per_adc=file.kev_per_adc,
        )  # fmt: skip

    def _of_channel(self, chosen: Mapping[str, str]) -> PulseSource:
        """Rows with the chosen values of some columns, or all if they are of one channel."""
        if self.n_pulses is None:
            return self
        whole = {n: c for n, c in self.columns.items() if len(c) == self.n_pulses}
        rows = np.arange(self.n_pulses)
        for name, value in chosen.items():
            if value == ANY:
                continue
            if name not in whole:
                raise CpunetError(
                    f"{self.path}: no column {name}; there are {shortened(whole)}"
                )
            values = texts(whole[name].read(0, self.n_pulses))
            rows = rows[values[rows] == value]
            if not len(rows):
                raise CpunetError(
                    f"{self.path}: no {name} {value}; it holds {shortened(np.unique(values))}"
                )
        of = {n: c.read(0, self.n_pulses)[rows] for n, c in whole.items() if divides(n)}
        of = {name: values for name, values in of.items() if name not in chosen}
        if names := dividing(of, len(rows)):
            channels = list(np.unique(labels(of, names)))
            also = ", or all for each" if self.format in ("LH5", "HDF5") else ""
            raise CpunetError(
                f"{self.path}: one table of {len(channels)} channels or detectors "
                f"({shortened(channels)})",
                f"choose one with `table` {channels[0]} (`sim_table`, `data_table`){also}; "
                f"{','.join(f'{name}={ANY}' for name in names)} takes them as one",
            )
        return self if len(rows) == self.n_pulses else self.at(rows)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

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
            traces = self.rows(start, start + size)
            if not len(traces):
                break
            yield self._pulses(start, traces)
            start += len(traces)
        if start == 0:
            raise CpunetError(f"{self.path}: holds no pulses; give a file with events")
        column = self.energy
        if column is not None and not column.constant and len(column) != start:
            raise CpunetError(
                f"{self.path}: {start} waveforms, but {len(column)} energies; "
                "give the energies of the same events"
            )

    def read(self, start: int = 0, stop: int | None = None) -> Pulses:
        """Read all pulses of the file, or some rows, at once; they must fit in memory."""
        if stop is None:
            return Pulses.concatenate(list(self.blocks()))
        return self._pulses(start, self.rows(start, stop))

    def _pulses(self, start: int, traces: npt.NDArray[Any]) -> Pulses:
        """Traces with their energies, numbers and times."""
        with np.errstate(over="ignore"):  # samples beyond the range of float32 become infinite
            waveforms = np.asarray(traces, np.float32)
        n, stop = len(waveforms), start + len(waveforms)
        numbers = np.arange(start, stop) if self.numbers is None else self.numbers(start, stop)
        energy_kev, t0_ns = np.full(n, np.nan), np.zeros(n)
        if self.energy is not None:
            energy_kev = self.energy.read(start, stop)
        elif self.kev_per_adc is not None:
            energy_kev = self.kev_per_adc * amplitude(waveforms)
        if len(energy_kev) != n:
            raise CpunetError(
                f"{self.path}: event {numbers[len(energy_kev)]} has no energy; "
                "give the energies of the same events"
            )
        event_number = whole_numbers(np.asarray(numbers), f"{self.path}: event_number", start)
        if self.period is not None:
            periods = self.period.read(start, stop)
            other = ~np.isclose(periods, self.dt_ns, rtol=TOLERANCE, atol=0)
            if other.any():
                first = int(other.argmax())
                raise CpunetError(
                    f"{self.path}: event {event_number[first]}: sampling period "
                    f"{periods[first]:g} ns, before it {self.dt_ns:g} ns; "
                    "split the file by sampling period"
                )
        if self.t0 is not None:
            t0_ns = self.t0.read(start, stop)
        return Pulses.of(
            waveforms, dt_ns=self.dt_ns, energy_kev=energy_kev, event_number=event_number,
            t0_ns=t0_ns,
        )  # fmt: skip


def _sampling(source: PulseSource, dt_ns: float | None) -> tuple[float, Column | None]:
    """The period in ns from the column of the file or from the user, and that of each trace.

    A column without units is not used, and ``dt_ns`` is required.  A file that says another
    period than the user is corrected, with a warning.
    """
    path, name, column = source.path, source.period_name, source.period
    in_ns = None if column is None else column.to("ns")
    if column is None or in_ns is None:
        if dt_ns is not None:
            return dt_ns, None
        why = "is not in the file" if column is None else f"({name}) has no units"
        if column is not None and column.units:
            why = f"({name}) is in {column.units!r}, not in one of {unit_names('ns')}"
        raise CpunetError(f"{path}: the sampling period {why}; give `dt_ns`")
    if len(column) != 1:
        column.require_length(path, name, source.n_pulses)
    period = float(in_ns.read(0, 1)[0])
    is_period = np.isfinite(period) and period > 0
    if dt_ns is None and not is_period:
        raise CpunetError(
            f"{path}: event 0: the sampling period ({name}) is {period:g} ns", "give `dt_ns`"
        )
    if dt_ns is not None and not np.isclose(period, dt_ns, rtol=TOLERANCE, atol=0):
        log.warning(
            f"{path.name}: says that it is sampled every {period:g} ns; taken as {dt_ns:g} ns, "
            "as given (`dt_ns`)"
        )
        if not is_period:
            return dt_ns, None
        in_ns, period = in_ns.times(dt_ns / period, "ns"), dt_ns
    # a scalar or an array of length 1 applies to all events
    return period, None if len(column) == 1 else in_ns


def _energies(
    source: PulseSource, energy: str | None, kev_per_adc: float | None
) -> tuple[str, Column | None]:
    """The rule of the energies in words, and energies in keV from a column.

    Without ``energy``, the column ``energy_kev``, ``energy_keV`` or ``energy`` is used if it
    is in energy units or ``kev_per_adc`` is given.  Otherwise the energy is the amplitude
    times ``kev_per_adc``, or unknown without it.  ``energy`` names another column, or
    ``FILE:path/to/column``.  Energies in units that are wrong or a little off are multiplied by
    ``kev_per_adc`` as well, with a warning.
    """
    path = source.path
    name = energy or next((name for name in _USUAL if name in source.columns), "")
    if name:
        column = source.columns[name] if name in source.columns else _elsewhere(source, name)
        units = column.units or ("keV" if _NAMED_IN_KEV.search(name) else "")
        by, rule = factor(units, "keV"), f"column {name} [{units}]"
        if by is None and kev_per_adc is not None:
            by, rule = kev_per_adc, f"column {name} x {kev_per_adc:g} keV/ADC"
        elif by is not None and kev_per_adc is not None:
            log.warning(
                f"{path.name}: column {name} is in {units}; its energies are multiplied by "
                f"{kev_per_adc:g}, as given (`kev_per_adc`)"
            )
            by, rule = by * kev_per_adc, f"{rule} x {kev_per_adc:g}"
        if by is not None:
            column.require_length(path, name, source.n_pulses)
            return rule, column.times(by, "keV")
        if energy is not None:
            units = f"in {column.units}" if column.units else "without units"
            raise CpunetError(
                f"{path}: column {name} is {units}, no energy in keV; "
                "add `kev_per_adc` (1 if it is in keV)"
            )
    if kev_per_adc is not None:
        return f"amplitude x {kev_per_adc:g} keV/ADC", None
    return f"not known{f' (column {name} is not in energy units)' if name else ''}", None


def _elsewhere(source: PulseSource, energy: str) -> Column:
    """A column of another file in the order of the pulses, if both tell of which events."""
    path, columns = source.path, source.columns
    file, colon, inner = energy.rpartition(":")
    if not colon:
        raise CpunetError(
            f"{path}: no column {energy} for the energy; there are {shortened(columns)}"
        )
    # Imported late: the LH5 library takes seconds to load, and most files do not need it.
    from cpunet.pulses.reading.hdf5 import column_of

    column, others = column_of(Path(file), inner)
    if (rows := source.chosen) is not None and len(column) == source.n_all:
        others = {n: c.at(rows) for n, c in others.items() if len(c) == len(column)}
        column = column.at(rows)
    key = next((k for k in EVENT_KEYS if k in columns and k in others), None)
    if key is None or columns[key].constant or len(others[key]) != len(column):
        return column
    ours, theirs = (np.asarray(c[key].read(0, len(c[key]))) for c in (columns, others))
    if np.array_equal(ours, theirs):
        return column
    _, at, of = np.intersect1d(ours, theirs, return_indices=True)
    if not len(at) or any(len(np.unique(keys)) < len(keys) for keys in (ours, theirs)):
        raise CpunetError(
            f"{path}: {energy} is of other events than these pulses ({key})",
            "give the energies of the same events",
        )
    log.info(
        f"{path.name}: {energy} is in another order or of other events; joined by {key}, "
        f"{len(ours) - len(at)} of {len(ours)} pulses have no energy there"
    )
    values = np.full(len(ours), np.nan)
    values[at] = np.asarray(column.read(0, len(column)), float)[of]
    return Column.of(values, column.units)
