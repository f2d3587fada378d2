"""Energies of pulses in keV and their sampling period: from the file or from the user."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.tables import shortened
from cpunet.units import factor, unit_names

if TYPE_CHECKING:
    from cpunet.hdf5_files import Read
    from cpunet.pulses.reading.files import PulseFile
    from cpunet.pulses.reading.source import RawTable

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Column:
    """One value per event, or a single value that applies to all events.

    Parameters
    ----------
    read
        Gives the values of the events from a first one to the one before a last.
    size
        Number of values.
    units
        Units in the file, ``""`` if there are none.
    constant
        Whether a single value applies to all events.
    """

    read: Read
    size: int
    units: str = ""
    constant: bool = False

    @classmethod
    def of(cls, values: npt.NDArray[Any], units: str = "") -> Self:
        """A column in memory; a scalar applies to all events."""
        if values.ndim == 0:
            return cls(lambda start, stop: np.full(stop - start, values), 1, units, True)
        return cls(lambda start, stop: values[start:stop], len(values), units)

    def __len__(self) -> int:
        return self.size

    def at(self, rows: npt.NDArray[np.int64]) -> Self:
        """The values of some rows, which ascend; one value for all stays."""
        if self.constant or len(self) == 1:
            return self
        return replace(self, read=partial(some_of, self.read, rows), size=len(rows))


def some_of(read: Read, rows: npt.NDArray[np.int64], start: int, stop: int) -> npt.NDArray[Any]:
    """Rows of a first to one before a last of those chosen, never more at once than these."""
    wanted, parts = rows[start:stop], list[npt.NDArray[Any]]()
    while len(wanted):
        n = int(np.searchsorted(wanted, wanted[0] + stop - start))
        parts.append(read(int(wanted[0]), int(wanted[n - 1]) + 1)[wanted[:n] - wanted[0]])
        wanted = wanted[n:]
    return np.concatenate(parts) if parts else read(0, 0)


def require_length(path: Path, name: str, column: Column, n_pulses: int | None) -> None:
    """Raise a `CpunetError` unless `column` has one value per pulse, or one for all."""
    if n_pulses is not None and not column.constant and len(column) != n_pulses:
        raise CpunetError(
            f"{path}: column {name} has {len(column)} values beside {n_pulses} waveforms; "
            "give the column of the same events"
        )


# Columns by which the rows of two files are joined.
EVENT_KEYS = ("event_number", "eventnumber", "evtid", "ievt", "timestamp")
_USUAL = ("energy_kev", "energy_keV", "energy")
# LEGEND's hit tier calls calibrated energies `cuspEmax_ctc_cal` and gives them no units.
_NAMED_IN_KEV = re.compile(r"(_cal|kev)$", re.IGNORECASE)

# The first samples of a trace, before any pulse, for the amplitude's baseline.
_BASELINE_FRACTION = 0.05
_BASELINE_SAMPLES = 10

# Files store periods in single precision.
TOLERANCE = 1e-5


@dataclass(frozen=True)
class Energies:
    """A rule that gives each pulse its energy in keV.

    Parameters
    ----------
    description
        The rule in words, for reports.
    kev_per_unit
        Factor from the column's values, or from the amplitude in ADC, to keV;
        None if energies are not known.
    column
        Column of the values; None to use the amplitude.
    """

    description: str
    kev_per_unit: float | None = None
    column: Column | None = None

    def of(self, start: int, waveforms: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Energies in keV of the pulses from row `start` on; NaN where unknown."""
        if self.kev_per_unit is None:
            return np.full(len(waveforms), np.nan)
        if self.column is None:
            return self.kev_per_unit * amplitude(waveforms)
        values = self.column.read(start, start + len(waveforms))
        return self.kev_per_unit * np.asarray(values, np.float64)


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


def resolve_energies(options: PulseFile, table: RawTable) -> Energies:
    """Choose where the energies of a file's pulses come from.

    Without ``energy``, the column ``energy_kev``, ``energy_keV`` or ``energy`` is used if it
    is in energy units or ``kev_per_adc`` is given.  Otherwise the energy is the amplitude
    times ``kev_per_adc``, or unknown without it.  ``energy`` names another column, or
    ``FILE:path/to/column``.  Energies in units that are wrong or a little off are multiplied by
    ``kev_per_adc`` as well, with a warning.

    Raises
    ------
    CpunetError
        If the column is missing, differs in length from the waveforms, or was requested but is
        neither in energy units nor calibrated.
    """
    path, kev_per_adc, columns = options.path, options.kev_per_adc, table.columns
    name = options.energy or next((name for name in _USUAL if name in columns), "")
    column = _named_column(path, table, name) if name else None
    if column is not None:
        rule = _calibrated(path, name, column, kev_per_adc)
        if rule is not None:
            require_length(path, name, column, table.n)
            return rule
        if options.energy is not None:
            units = f"in {column.units}" if column.units else "without units"
            raise CpunetError(
                f"{path}: column {name} is {units}, no energy in keV; "
                "add `kev_per_adc` (1 if it is in keV)"
            )
    if kev_per_adc is not None:
        return Energies(f"amplitude x {kev_per_adc:g} keV/ADC", kev_per_adc)
    return Energies(f"not known{f' (column {name} is not in energy units)' if name else ''}")


def _calibrated(
    path: Path, name: str, column: Column, kev_per_adc: float | None
) -> Energies | None:
    units = column.units or ("keV" if _NAMED_IN_KEV.search(name) else "")
    kev_per_unit = factor(units, "keV")
    if kev_per_unit is None:
        if kev_per_adc is None:
            return None
        return Energies(f"column {name} x {kev_per_adc:g} keV/ADC", kev_per_adc, column)
    if kev_per_adc is None:
        return Energies(f"column {name} [{units}]", kev_per_unit, column)
    log.warning(
        f"{path.name}: column {name} is in {units}; its energies are multiplied by "
        f"{kev_per_adc:g}, as given (`kev_per_adc`)"
    )
    rule = f"column {name} [{units}] x {kev_per_adc:g}"
    return Energies(rule, kev_per_unit * kev_per_adc, column)


def _named_column(path: Path, table: RawTable, energy: str) -> Column:
    columns = table.columns
    if energy in columns:
        return columns[energy]
    file, colon, inner = energy.rpartition(":")
    if not colon:
        raise CpunetError(
            f"{path}: no column {energy} for the energy; there are {shortened(columns)}"
        )
    # Imported late: the LH5 library takes seconds to load, and most files do not need it.
    from cpunet.pulses.reading.hdf5 import column_of

    column, others = column_of(Path(file), inner)
    if (rows := table.chosen) is not None and len(column) == table.n_all:
        others = {n: c.at(rows) for n, c in others.items() if len(c) == len(column)}
        column = column.at(rows)
    return _joined(path, columns, energy, column, others)


def _joined(
    path: Path,
    columns: Mapping[str, Column],
    energy: str,
    column: Column,
    beside: Mapping[str, Column],
) -> Column:
    """A column of another file in the order of the pulses, if both tell of which events."""
    key = next((k for k in EVENT_KEYS if k in columns and k in beside), None)
    if key is None or columns[key].constant or len(beside[key]) != len(column):
        return column
    ours, theirs = (np.asarray(c[key].read(0, len(c[key]))) for c in (columns, beside))
    if np.array_equal(ours, theirs):
        return column
    order = np.argsort(theirs, kind="stable")
    at = order[np.minimum(np.searchsorted(theirs[order], ours), len(theirs) - 1)]
    found = theirs[at] == ours
    if not found.any() or any(len(np.unique(keys)) < len(keys) for keys in (ours, theirs)):
        what = f"{(~found).sum()} of {len(ours)} are not there" if not found.all() else "twice"
        raise CpunetError(
            f"{path}: {energy} is of other events than these pulses ({key}: {what})",
            "give the energies of the same events",
        )
    log.info(
        f"{path.name}: {energy} is in another order or of other events; joined by {key}, "
        f"{(~found).sum()} of {len(ours)} pulses have no energy there"
    )
    values = np.where(found, np.asarray(column.read(0, len(column)), float)[at], np.nan)
    return Column.of(values, column.units)


def resolve_sampling(options: PulseFile, table: RawTable) -> tuple[float, Read | None]:
    """Take the period from the column of the file or from the user's ``dt_ns``.

    A column without units is in ns if its name ends in ``_ns``. Otherwise it is not used
    and ``dt_ns`` is required; the error message contains the hint of the format.  A file that
    says another period than the user is corrected, with a warning.

    Returns
    -------
    dt_ns
        Sampling period in ns.
    periods
        Reads that of each trace in ns, if the file has it for each.

    Raises
    ------
    CpunetError
        If neither gives the period, or if it is not a positive number.
    """
    path, dt_ns = options.path, options.dt_ns
    name, column, hint = table.period_name, table.period, table.period_hint
    try:
        ns_per_unit = None if column is None else _ns_per_unit(path, name, column)
    except CpunetError:
        if dt_ns is None:
            raise
        ns_per_unit = None
    if column is None or ns_per_unit is None:
        if dt_ns is None:
            why = "is not in the file" if column is None else f"({name}) has no units"
            raise CpunetError(
                f"{path}: the sampling period {why}; give `dt_ns`{hint and f' ({hint})'}"
            )
        return dt_ns, None
    if len(column) != 1:
        require_length(path, name, column, table.n)
    found = float(column.read(0, 1)[0]) * ns_per_unit
    if dt_ns is not None and not np.isclose(found, dt_ns, rtol=TOLERANCE, atol=0):
        log.warning(
            f"{path.name}: says that it is sampled every {found:g} ns; taken as {dt_ns:g} ns, "
            "as given (`dt_ns`)"
        )
        if not (np.isfinite(found) and found > 0):
            return dt_ns, None
        ns_per_unit *= dt_ns / found
        found = dt_ns
    if not (np.isfinite(found) and found > 0):
        raise CpunetError(
            f"{path}: event 0: the sampling period ({name}) is {found:g} ns", "give `dt_ns`"
        )
    if len(column) == 1:  # a scalar or an array of length 1 applies to all events
        return found, None
    return found, lambda start, stop: ns_per_unit * np.asarray(column.read(start, stop), float)


def _ns_per_unit(path: Path, name: str, column: Column) -> float | None:
    units = column.units or ("ns" if name.endswith("_ns") else "")
    if not units:
        return None
    if (ns_per_unit := factor(units, "ns")) is None:
        raise CpunetError(
            f"{path}: the sampling period ({name}) is in {units!r}; expected one of "
            f"{unit_names('ns')}"
        )
    return ns_per_unit
