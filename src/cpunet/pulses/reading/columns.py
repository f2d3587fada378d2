"""Columns of a table: a value for each event; and those that separate channels or detectors."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.units import factor

if TYPE_CHECKING:
    from cpunet.hdf5_files import Read

Texts = npt.NDArray[np.str_]

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

    load: Callable[[], npt.NDArray[Any]]
    size: int
    units: str = ""

    @classmethod
    def of(cls, values: npt.NDArray[Any], units: str = "") -> Column:
        """A column in memory."""
        return cls(lambda: values, values.size, units)

    @cached_property
    def values(self) -> npt.NDArray[Any]:
        """All values, which are read when they are asked for."""
        return self.load()

    def to(self, unit: str) -> npt.NDArray[np.float64] | None:
        """The values in ns or keV, see `cpunet.units`; None if they are in no such units."""
        by = factor(self.units, unit)
        return None if by is None else by * np.asarray(self.values, np.float64)

    def at(self, rows: npt.NDArray[np.int64], n: int | None) -> Column:
        """The values of some of `n` rows; a number for all stays."""
        if self.size != n:
            return self
        return Column(lambda: self.values[rows], len(rows), self.units)


def some_of(read: Read, rows: npt.NDArray[np.int64], start: int, stop: int) -> npt.NDArray[Any]:
    """Rows of a first to one before a last of those chosen, never more at once than these."""
    wanted, parts = rows[start:stop], list[npt.NDArray[Any]]()
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


def texts(values: npt.NDArray[Any]) -> Texts:
    """Values as text; whole numbers without a decimal point."""
    if values.dtype.kind == "f" and np.array_equal(values, np.rint(values)):
        values = values.astype(np.int64)
    if values.dtype.kind in "SO":
        return np.array([x.decode() if isinstance(x, bytes) else str(x) for x in values])
    return values.astype(np.str_)


def dividing(columns: Mapping[str, npt.NDArray[Any]], rows: int) -> list[str]:
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
    for name, (values, code) in sorted(
        coded.items(), key=lambda item: (-len(item[1][0]), item[0])
    ):
        both, joined = np.unique(parts * len(values) + code, return_inverse=True)
        if groups < len(both) <= min(_MOST, rows / _FEWEST):
            chosen, groups, parts = [*chosen, name], len(both), joined
    return chosen


def labels(columns: Mapping[str, npt.NDArray[Any]], names: Iterable[str]) -> Texts:
    """Label of each row, as ``channel=3`` or ``card=1,channel=3``."""
    parts = [np.strings.add(f"{name}=", texts(columns[name])) for name in names]
    add = np.strings.add
    return np.asarray(reduce(lambda label, part: add(add(label, ","), part), parts), np.str_)


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
        plain = values.dtype.kind in "uf"
        numbers = values.astype(float) if plain else np.full(len(values), np.nan)
        bad = ~((numbers == np.rint(numbers)) & (np.abs(numbers) < _MAX_NUMBER))
        if bad.any():
            row = int(bad.argmax())
            raise CpunetError(
                f"{where}: row {start + row}: {values[row]} is no number of an event; number "
                "the events anew"
            )
    return values.astype(np.int64)
