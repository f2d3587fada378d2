"""Columns that separate the channels or detectors in one table."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

Texts = npt.NDArray[np.str_]

_NUMBERED = r"(?:_?(?:id|uid|no|nr|num|number|index|idx|name))"
_DIVIDES = re.compile(
    r"(?:f|fc|adc|daq|hw|fadc|digi)?_?(?:ch|chn|chan|channel|card|crate|slot|board|module|input|"
    r"fadc|digitizer|det|detector|contact|seg|segment|crystal|core|volume|replica|geds?|hpge)"
    rf"{_NUMBERED}?|(?:raw|vol|copy|rep|fc|daq){_NUMBERED}|irep",
    re.IGNORECASE,
)
_MOST, _FEWEST = 512, 2  # channels of an experiment, and rows of each on average


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
    joined = parts[0]
    for part in parts[1:]:
        joined = np.strings.add(np.strings.add(joined, ","), part)
    return np.asarray(joined, np.str_)
