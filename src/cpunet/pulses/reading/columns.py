"""Columns beside the waveforms: one value per event, with units, read by rows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError

# Factors to keV and ns.  A dictionary rather than a units library: only these units occur
# beside waveforms, and any other must be refused, not converted.
ENERGY_UNITS = {"eV": 1e-3, "keV": 1.0, "MeV": 1e3}
TIME_UNITS = {"ps": 1e-3, "ns": 1.0, "us": 1e3, "µs": 1e3, "ms": 1e6, "s": 1e9}

_SHOWN = 6


class Column(Protocol):
    """One value per event, or a single value that applies to all events."""

    @property
    def units(self) -> str:
        """Units in the file, ``""`` if there are none."""
        ...

    @property
    def constant(self) -> bool:
        """Whether a single value applies to all events."""
        ...

    def __len__(self) -> int: ...

    def read(self, start: int, stop: int) -> npt.NDArray[Any]:
        """Values of the events `start` to `stop` - 1."""
        ...


@dataclass(frozen=True)
class MemoryColumn:
    """A column in memory; a scalar applies to all events."""

    values: npt.NDArray[Any]
    units: str = ""

    @property
    def constant(self) -> bool:
        """Whether a single value applies to all events."""
        return self.values.ndim == 0

    def __len__(self) -> int:
        return self.values.size

    def read(self, start: int, stop: int) -> npt.NDArray[Any]:
        """Values of the events `start` to `stop` - 1."""
        if self.constant:
            return np.full(stop - start, self.values)
        return self.values[start:stop]


def shortened(names: Iterable[str]) -> str:
    """A readable list of names that stays on one line.

    Examples
    --------
    >>> shortened(["FEP", "SEP"])
    'FEP, SEP'
    >>> shortened(f"ch{i}" for i in range(20))
    'ch0, ch1, ch2, ch3, ch4, ch5 and 14 more'
    """
    listed = list(names)
    text = ", ".join(listed[:_SHOWN]) or "nothing"
    rest = len(listed) - _SHOWN
    return f"{text} and {rest} more" if rest > 0 else text


def require_length(path: Path, name: str, column: Column, n_pulses: int | None) -> None:
    """Raise a `CpunetError` unless `column` has one value per pulse, or one for all."""
    if n_pulses is not None and not column.constant and len(column) != n_pulses:
        raise CpunetError(
            f"{path}: column {name} has {len(column)} values beside {n_pulses} waveforms; "
            "give the column of the same events"
        )
