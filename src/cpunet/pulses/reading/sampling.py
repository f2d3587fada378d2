"""The sampling period: from the file or from the user, the same for every event."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.reading.columns import TIME_UNITS, Column, require_length

# Files store periods in single precision.
_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Sampling:
    """The sampling period in ns, and the column that must agree with it."""

    path: Path
    dt_ns: float
    column: Column | None = None
    ns_per_unit: float = 1.0

    def check(self, start: int, event_number: npt.NDArray[np.int64]) -> None:
        """Raise a `CpunetError` that names the first event with another sampling period."""
        if self.column is None:
            return
        values = self.column.read(start, start + len(event_number))
        periods = self.ns_per_unit * np.asarray(values, np.float64)
        other = ~np.isclose(periods, self.dt_ns, rtol=_TOLERANCE, atol=0)
        if other.any():
            first = int(other.argmax())
            raise CpunetError(
                f"{self.path}: event {event_number[first]}: sampling period "
                f"{periods[first]:g} ns, before it {self.dt_ns:g} ns; "
                "split the file by sampling period"
            )


def resolve_sampling(
    path: Path,
    name: str,
    column: Column | None,
    *,
    dt_ns: float | None,
    n_pulses: int | None = None,
    hint: str = "",
) -> Sampling:
    """Take the period from `column` (called `name`) or from the user's `dt_ns`.

    A column without units is in ns if its name ends in ``_ns``. Otherwise it is not used
    and `dt_ns` is required; the error message contains `hint`.

    Raises
    ------
    CpunetError
        If neither gives the period, if they disagree, or if it is not a positive number.
    """
    ns_per_unit = None if column is None else _ns_per_unit(path, name, column)
    if column is None or ns_per_unit is None:
        if dt_ns is None:
            why = "is not in the file" if column is None else f"({name}) has no units"
            raise CpunetError(
                f"{path}: the sampling period {why}; give --dt-ns{hint and f' ({hint})'}"
            )
        return Sampling(path, dt_ns)
    if len(column) != 1:
        require_length(path, name, column, n_pulses)
    found = float(column.read(0, 1)[0]) * ns_per_unit
    if not (np.isfinite(found) and found > 0):
        raise CpunetError(
            f"{path}: event 0: the sampling period is {found:g} ns; "
            f"correct column {name} of the file"
        )
    if dt_ns is not None and not np.isclose(found, dt_ns, rtol=_TOLERANCE, atol=0):
        raise CpunetError(
            f"{path}: sampled every {found:g} ns, but --dt-ns says {dt_ns:g}; drop --dt-ns"
        )
    # A single value, a scalar or an array of length 1, applies to all events.
    varying = None if len(column) == 1 else column
    return Sampling(path, found, varying, ns_per_unit)


def _ns_per_unit(path: Path, name: str, column: Column) -> float | None:
    units = column.units or ("ns" if name.endswith("_ns") else "")
    if not units:
        return None
    if units not in TIME_UNITS:
        raise CpunetError(
            f"{path}: the sampling period ({name}) is in {units!r}; "
            f"known are {', '.join(TIME_UNITS)}"
        )
    return TIME_UNITS[units]
