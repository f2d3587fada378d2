"""A file of pulses of any format, open: its traces and columns, and pulses in blocks.

Columns have a value for each event; some separate channels or detectors.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property, partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses, Rows
from cpunet.tables import shortened
from cpunet.units import factor, unit_names

if TYPE_CHECKING:  # of libraries that other formats do not need
    import h5py

    from cpunet.pulses.reading.files import PulseFile

log = logging.getLogger(__name__)

BLOCK_BYTES = 1 << 28  # maximum size of a block of float32 traces
ANY = "*"  # value of a column that separates no channels

_USUAL = ("energy_kev", "energy_keV", "energy", "energy_label")
# LEGEND's hit tier calls calibrated energies `cuspEmax_ctc_cal` and gives them no units, the
# release of the Majorana Demonstrator `energy_label`.
_NAMED_IN_KEV = re.compile(r"(_cal|kev|energy_label)$", re.IGNORECASE)

_NUMBERED = r"(?:_?(?:id|uid|no|nr|num|number|index|idx|name))"
_DIVIDES = re.compile(
    r"(?:f|fc|adc|daq|hw|fadc|digi)?_?(?:ch|chn|chan|channel|card|crate|slot|board|module|input|"
    r"fadc|digitizer|det|detector|contact|seg|segment|crystal|core|volume|replica|geds?|hpge)"
    rf"{_NUMBERED}?|(?:raw|vol|copy|rep|fc|daq){_NUMBERED}|irep",
    re.IGNORECASE,
)
# Columns by which the rows of two files are joined; the last is no number of an event.
EVENT_KEYS = ("event_number", "eventnumber", "evtid", "ievt", "timestamp")
_MOST, _FEWEST = 512, 2  # channels of an experiment, and rows of each on average
_MAX_NUMBER = 2.0**62

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


Values = npt.NDArray[Any]
Texts = npt.NDArray[np.str_]
Read = Callable[[int, int], Values]  # rows from one to before another


@dataclass(frozen=True, eq=False)
class Column:
    """One value per event, or a single number that applies to all events.

    Parameters
    ----------
    load
        Gives the values, of no dimension if they are a number that applies to all.
    size
        Number of values.
    units
        Units in the file, ``""`` if there are none.
    """

    load: Callable[[], Values]
    size: int
    units: str = ""

    @classmethod
    def of(cls, values: Values, units: str = "") -> Column:
        """A column in memory."""
        return cls(lambda: values, values.size, units)

    @cached_property
    def values(self) -> Values:
        """All values, which are read when they are asked for."""
        return self.load()

    def at(self, rows: Rows, n: int | None) -> Column:
        """The values of some of `n` rows; a number for all stays."""
        if self.size != n:
            return self
        return Column(lambda: self.values[rows], len(rows), self.units)


def some_of(read: Read, rows: Rows, start: int, stop: int) -> Values:
    """Rows of a first to one before a last of those chosen, never more at once than these."""
    wanted, parts = rows[start:stop], list[Values]()
    while len(wanted):
        n = int(np.searchsorted(wanted, wanted[0] + stop - start))
        parts.append(read(int(wanted[0]), int(wanted[n - 1]) + 1)[wanted[:n] - wanted[0]])
        wanted = wanted[n:]
    return np.concatenate(parts) if parts else read(0, 0)


def divides(name: str) -> bool:
    """Whether a column of this name separates channels or detectors.

    Examples
    --------
    >>> [name for name in ("channel", "fch_id", "volID", "copyNo", "epoch") if divides(name)]
    ['channel', 'fch_id', 'volID', 'copyNo']
    """
    return _DIVIDES.fullmatch(name) is not None


def texts(values: Values) -> Texts:
    """Values as text; whole numbers without a decimal point."""
    if values.dtype.kind == "f" and np.array_equal(values, np.rint(values)):
        values = values.astype(np.int64)
    if values.dtype.kind in "SO":
        return np.array([x.decode() if isinstance(x, bytes) else str(x) for x in values])
    return values.astype(np.str_)


def dividing(columns: Mapping[str, Values], rows: int) -> list[str]:
    """The fewest of some columns that part the rows as all of them do; none if none does.

    Examples
    --------
    >>> card, channel = np.repeat([1, 2], 4), np.tile([0, 0, 3, 3], 2)
    >>> dividing({"card": card, "channel": channel, "crate": 0 * card}, 8)
    ['card', 'channel']
    >>> dividing({"card": card, "channel": channel, "rawid": 10 * card + channel}, 8)
    ['rawid']
    """
    chosen, groups, parts = list[str](), 1, np.zeros(rows, np.int64)
    coded = {name: np.unique(v, return_inverse=True) for name, v in columns.items()}
    for name in sorted(coded, key=lambda name: (-len(coded[name][0]), name)):
        values, code = coded[name]
        both, joined = np.unique(parts * len(values) + code, return_inverse=True)
        if groups < len(both) <= min(_MOST, rows / _FEWEST):
            chosen, groups, parts = [*chosen, name], len(both), joined
    return chosen


def labels(columns: Mapping[str, Values], names: Iterable[str]) -> Texts:
    """Label of each row, as ``channel=3`` or ``card=1,channel=3``."""
    parts = [np.strings.add(f"{name}=", texts(columns[name])) for name in names]
    add = np.strings.add
    return np.asarray(reduce(lambda label, part: add(add(label, ","), part), parts), np.str_)


def parts(columns: Mapping[str, Column], rows: Rows) -> tuple[list[str], list[str]]:
    """The columns that part some rows, see `dividing`, and the labels of the parts."""
    of = {name: np.atleast_1d(c.values)[rows] for name, c in columns.items() if divides(name)}
    names = dividing(of, len(rows))
    return names, list(np.unique(labels(of, names))) if names else []


def whole_numbers(values: Values, where: str, start: int = 0) -> npt.NDArray[np.int64]:
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
        plain = values.dtype.kind in "uf"
        numbers = values.astype(float) if plain else np.full(len(values), np.nan)
        bad = ~((numbers == np.rint(numbers)) & (np.abs(numbers) < _MAX_NUMBER))
        if bad.any():
            row = int(bad.argmax())
            text = f"{where}: row {start + row}: {values[row]} is no number of an event"
            raise CpunetError(text, "number the events anew")
    return values.astype(np.int64)


@dataclass(eq=False, repr=False)
class PulseSource(AbstractContextManager["PulseSource"]):
    """Pulses of an open file: iterate over its `blocks`, or `read` it as a whole.

    The reader of a format gives the content, and `resolve` the sampling period and the
    energies.  The file is closed at the end of a ``with``, or with the last reference to this.
    The memory in use does not grow with the traces of a file, except for ``.npz`` and pickles,
    which are read as a whole.

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
    times
        Sampling periods ``dt`` and times of the first samples ``t0`` that are no columns.
    attrs
        What the file says about the traces: side, maker, detector.
    of_each
        Values of each trace, as far as the file has them: ``energy_kev``, ``event_number``,
        ``t0_ns``, and ``dt_ns`` if there are several.
    group, close
        Group of an HDF5 file with columns of any kind; closes the file.

    Attributes
    ----------
    chosen, n_all
        Rows of the table that are read, and how many it has; None if all are.
    dt_ns
        Sampling period in ns.
    energies
        The rule that gives each pulse its energy, in words.
    kev_per_adc
        The factor from the amplitude to the energy, if there are no energies.
    """

    path: Path
    format: str
    name: str
    n_pulses: int | None
    length: int
    rows: Read
    columns: dict[str, Column] = field(default_factory=dict)
    times: dict[str, Column] = field(default_factory=dict)
    attrs: Mapping[str, str] = field(default_factory=dict)
    of_each: dict[str, Any] = field(default_factory=dict)
    group: h5py.Group | None = None
    close: Callable[[], None] = lambda: None
    chosen: Rows | None = field(default=None, init=False)
    n_all: int | None = field(default=None, init=False)
    dt_ns: float = field(default=np.nan, init=False)
    energies: str = field(default="", init=False)
    kev_per_adc: float | None = field(default=None, init=False)

    def resolve(self, file: PulseFile) -> Self:
        """Take the rows, the sampling period and the energies that the user chose.

        Raises
        ------
        CpunetError
            If it holds no pulses, or those of several channels, or the options do not fit.
        """
        n, sizes = self.n_pulses, {column.size for column in self.columns.values()}
        if n == 0 or self.length == 0:
            text = f"{self.path}: {self.name or self.format} holds no pulses"
            raise CpunetError(text, "give a file with events")
        if self.length in sizes and n not in sizes:  # as Julia and MATLAB write arrays
            text = f"traces of shape {(n, self.length)} with columns of {self.length}"
            remedy = "write them transposed, with the pulses first"
            raise CpunetError(f"{self.path}: {text}: their dimensions are reversed", remedy)
        if n is not None:
            self._choose(file.rows, n)
        self._sample(file.dt_ns)
        self._calibrate(file.energy, file.kev_per_adc)
        t0 = self.times.get("t0")
        if t0 is not None and (by := factor(t0.units, "ns")) is not None:
            self.of_each["t0_ns"] = np.broadcast_to(by * t0.values, (self.n_pulses or 0,))
        if name := next((name for name in EVENT_KEYS[:-1] if name in self.columns), None):
            self.of_each["event_number"] = self._of_each(name, self.columns[name])
        return self

    def _of_each(self, name: str, column: Column) -> Values:
        """Values of a column, which must be as many as there are traces, or one for all."""
        values, n = column.values, self.n_pulses
        if n is not None and values.shape not in ((), (n,)):
            text = f"{self.path}: column {name} has {len(values)} values for {n} waveforms"
            raise CpunetError(text, "give the column of the same events")
        return np.atleast_1d(values) if n is None else np.broadcast_to(values, (n,))

    def _choose(self, wanted: Mapping[str, str], n: int) -> None:
        """Choose rows by values of some columns; all must be of one channel."""
        whole = {name: c for name, c in self.columns.items() if c.size == n}
        rows = np.arange(n)
        for name, value in wanted.items():
            if value == ANY:
                continue
            if name not in whole:
                raise CpunetError(
                    f"{self.path}: no column {name}; there are {shortened(whole)}"
                )
            values = texts(np.atleast_1d(whole[name].values))
            rows = rows[values[rows] == value]
            if not len(rows):
                raise CpunetError(
                    f"{self.path}: no {name} {value}; it holds {shortened(np.unique(values))}"
                )
        names, channels = parts({n: c for n, c in whole.items() if n not in wanted}, rows)
        if channels:
            also = ", or all for each" if self.format in ("LH5", "HDF5") else ""
            raise CpunetError(
                f"{self.path}: one table of {len(channels)} channels or detectors "
                f"({shortened(channels)})",
                f"choose one with `table` {channels[0]} (`sim_table`, `data_table`){also}; "
                f"{','.join(f'{name}={ANY}' for name in names)} takes them as one",
            )
        if len(rows) == n:
            return
        self.chosen, self.n_all, self.n_pulses = rows, n, len(rows)
        self.rows = partial(some_of, self.rows, rows)
        self.columns = {name: column.at(rows, n) for name, column in self.columns.items()}
        self.times = {name: column.at(rows, n) for name, column in self.times.items()}

    def _sample(self, dt_ns: float | None) -> None:
        """Take the period from the column of the file or from the user.

        A column without units is not used, and ``dt_ns`` is required.  A file that says
        another period than the user is corrected, with a warning.
        """
        of = self.times if "dt" in self.times else self.columns
        name = "dt_ns" if "dt_ns" in of else "dt"
        column = of.get(name)
        units = "" if column is None else column.units or ("ns" if name == "dt_ns" else "")
        if column is None or (by := factor(units, "ns")) is None:
            why = "is not in the file" if column is None else f"({name}) has no units"
            if units:
                why = f"({name}) is in {units!r}, not in one of {unit_names('ns')}"
            if dt_ns is None:
                raise CpunetError(f"{self.path}: the sampling period {why}; give `dt_ns`")
            self.dt_ns = dt_ns
            return
        if column.size != 1:
            self._of_each(name, column)
        periods = by * np.asarray(column.values, np.float64)
        self.dt_ns = period = float(periods.flat[0])
        is_period = np.isfinite(period) and period > 0
        if dt_ns is None and not is_period:
            text = f"{self.path}: event 0: the sampling period ({name}) is {period:g} ns"
            raise CpunetError(text, "give `dt_ns`")
        if dt_ns is not None and not np.isclose(period, dt_ns, rtol=TOLERANCE, atol=0):
            text = f"says that it is sampled every {period:g} ns; taken as {dt_ns:g} ns"
            log.warning(f"{self.path.name}: {text}, as given (`dt_ns`)")
            self.dt_ns = dt_ns
        if column.size > 1 and is_period:  # a single value applies to all events
            self.of_each["dt_ns"] = periods * (self.dt_ns / period)

    def _calibrate(self, energy: str | None, kev_per_adc: float | None) -> None:
        """Take the energies in keV from a column, and say by which rule.

        Without ``energy``, the column ``energy_kev``, ``energy_keV`` or ``energy`` is used if
        it is in energy units or ``kev_per_adc`` is given.  Otherwise the energy is the
        amplitude times ``kev_per_adc``, or unknown without it.  ``energy`` names another
        column, or ``FILE:path/to/column``.  Energies in units that are wrong or a little off
        are multiplied by ``kev_per_adc`` as well, with a warning.
        """
        self.kev_per_adc, self.energies = kev_per_adc, "not known"
        if kev_per_adc is not None:
            self.energies = f"amplitude x {kev_per_adc:g} keV/ADC"
        name = energy or next((name for name in _USUAL if name in self.columns), None)
        if name is None:
            return
        column = self.columns.get(name)
        if column is None and ":" in name:
            from cpunet.pulses.reading import hdf5  # which other formats do not need

            column = hdf5.column_elsewhere(self, name)
        if column is None:
            text = f"no column {name} for the energy; there are {shortened(self.columns)}"
            raise CpunetError(f"{self.path}: {text}")
        units = column.units or ("keV" if _NAMED_IN_KEV.search(name) else "")
        by, rule = factor(units, "keV"), f"column {name} [{units}]"
        if by is not None and kev_per_adc is not None:
            text = f"is in {units}; its energies are multiplied by {kev_per_adc:g}"
            log.warning(f"{self.path.name}: column {name} {text}, as given (`kev_per_adc`)")
            by, rule = by * kev_per_adc, f"{rule} x {kev_per_adc:g}"
        elif kev_per_adc is not None:
            by, rule = kev_per_adc, f"column {name} x {kev_per_adc:g} keV/ADC"
        if by is not None:
            values = np.asarray(self._of_each(name, column), np.float64)
            self.energies, self.of_each["energy_kev"] = rule, by * values
        elif energy is None:
            self.energies = f"not known (column {name} is not in energy units)"
        else:
            units = f"in {column.units}" if column.units else "without units"
            raise CpunetError(
                f"{self.path}: column {name} is {units}, no energy in keV; "
                "add `kev_per_adc` (1 if it is in keV)"
            )

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
        while start != self.n_pulses and len(pulses := self.read(start, start + size)):
            yield pulses
            start += len(pulses)
        if start == 0:
            raise CpunetError(f"{self.path}: holds no pulses; give a file with events")
        if (energies := len(self.of_each.get("energy_kev", range(start)))) != start:
            text = f"{self.path}: {start} waveforms, but {energies} energies"
            raise CpunetError(text, "give the energies of the same events")

    def read(self, start: int = 0, stop: int | None = None) -> Pulses:
        """Read all pulses of the file, or some rows, at once; they must fit in memory."""
        if stop is None:
            return Pulses.concatenate(list(self.blocks()))[start:]
        with np.errstate(over="ignore"):  # samples beyond the range of float32 become infinite
            waveforms = np.asarray(self.rows(start, stop), np.float32)
        n = len(waveforms)
        of_each = {name: values[start : start + n] for name, values in self.of_each.items()}
        numbers = of_each.get("event_number", np.arange(start, start + n))
        kev, t0_ns = of_each.get("energy_kev"), of_each.get("t0_ns", 0.0)
        if kev is None and self.kev_per_adc is not None:
            kev = self.kev_per_adc * amplitude(waveforms)
        if kev is not None and len(kev) != n:
            remedy = "give the energies of the same events"
            raise CpunetError(f"{self.path}: event {numbers[len(kev)]} has no energy", remedy)
        event_number = whole_numbers(np.asarray(numbers), f"{self.path}: event_number", start)
        periods = of_each.get("dt_ns", np.full(n, self.dt_ns))
        other = ~np.isclose(periods, self.dt_ns, rtol=TOLERANCE, atol=0)
        if other.any():
            first = int(other.argmax())
            text = f"sampling period {periods[first]:g} ns, before it {self.dt_ns:g} ns"
            remedy = "split the file by sampling period"
            raise CpunetError(f"{self.path}: event {event_number[first]}: {text}", remedy)
        return Pulses.of(
            waveforms, dt_ns=self.dt_ns, energy_kev=kev, event_number=event_number, t0_ns=t0_ns
        )
