"""Steps of a simulation as read, and their conversion to hits in the crystal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.simulation.hits import FARTHEST_MM, MAX_KEV, Hits

FloatArray = npt.NDArray[np.float64]

_MAX_NUMBER = 2.0**62
_MM = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "µm": 1e-3}
_KEV = {"keV": 1.0, "MeV": 1e3, "eV": 1e-3, "GeV": 1e6}


@dataclass(frozen=True)
class Transform:
    """Transformation from the frame of a file to that of the crystal.

    Subtracts `origin_mm`. With `flip_z` it then mirrors z (and y, so that the frame remains
    right-handed), for crystals with the point contact on top. `origin_mm` is the centre of
    the face of the contact.
    """

    origin_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    flip_z: bool = False

    def apply(self, position_mm: FloatArray) -> FloatArray:
        """Transform positions of shape ``(n, 3)`` in mm to the frame of the crystal."""
        moved = position_mm - np.asarray(self.origin_mm)
        mirror = np.array([1.0, -1.0, -1.0]) if self.flip_z else np.ones(3)
        return np.asarray(moved * mirror, np.float64)


@dataclass(frozen=True)
class Units:
    """Units of columns that name none; None if the user gave none."""

    length: str | None = None
    energy: str | None = None

    def to_mm(self, path: Path, column: str, named: str | None) -> float:
        """Conversion factor from the unit of a column to mm."""
        return _factor(path, column, named or self.length, _MM, "length_unit")

    def to_kev(self, path: Path, column: str, named: str | None) -> float:
        """Conversion factor from the unit of a column to keV."""
        return _factor(path, column, named or self.energy, _KEV, "energy_unit")


@dataclass(frozen=True)
class Steps:
    """Steps relative to the detector's origin in the frame of a file; events in any order."""

    event: npt.NDArray[np.int64]
    position_mm: FloatArray
    edep_kev: FloatArray


@dataclass(frozen=True)
class ReadHits:
    """Hits of a file, and the number of steps without energy deposit, which are omitted."""

    hits: Hits
    steps_without_energy: int


def to_hits(path: Path, steps: Steps, transform: Transform) -> ReadHits:
    """Group steps by event, in the order of the file, in the frame of the crystal.

    Raises
    ------
    CpunetError
        If a step has no finite position or energy, or a negative energy.
    """
    # written so that NaN fails
    placed = (np.abs(steps.position_mm) <= FARTHEST_MM).all(axis=1)
    bad = ~(placed & (steps.edep_kev >= 0) & (steps.edep_kev <= MAX_KEV))
    if bad.any():
        event = steps.event[np.argmax(bad)]
        raise CpunetError(
            f"{path}: event {event}: a step has no finite position or no energy of at least 0 "
            f"(nor may it lie {FARTHEST_MM / 1e6:g} km away or have {MAX_KEV / 1e9:g} TeV); "
            "remove the event or simulate again"
        )
    kept = steps.edep_kev > 0
    numbers, first, label = np.unique(steps.event[kept], return_index=True, return_inverse=True)
    in_file = np.argsort(first)
    rank = np.empty_like(in_file)
    rank[in_file] = np.arange(len(in_file))
    # steps of one event need not be adjacent, as in files merged from several threads
    order = np.argsort(rank[label], kind="stable")
    counts = np.bincount(rank[label], minlength=len(numbers))
    hits = Hits.of(
        transform.apply(steps.position_mm[kept][order]),
        steps.edep_kev[kept][order],
        np.concatenate([[0], np.cumsum(counts)]),
        numbers[in_file],
    )
    return ReadHits(hits, int((~kept).sum()))


def require_some(path: Path, n_events: int) -> None:
    """Raise a `CpunetError` if there is no event with a deposit."""
    if not n_events:
        raise CpunetError(f"{path}: no step deposits energy; check the detector's name")


def whole_numbers(path: Path, name: str, values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Convert a column of whole numbers, which may be stored as floats, to int64.

    Raises
    ------
    CpunetError
        If a value is not a whole number or too large.
    """
    kind = values.dtype.kind
    fit = kind in "iuf" and bool((np.abs(values.astype(float)) < _MAX_NUMBER).all())
    if fit and kind == "f":
        fit = bool((values == np.rint(values)).all())
    if not fit:
        raise CpunetError(f"{path}: {name} holds what is no whole number; write it again")
    return values.astype(np.int64)


def _factor(
    path: Path, column: str, unit: str | None, known: dict[str, float], option: str
) -> float:
    if unit is None:
        raise CpunetError(
            f"{path}: column {column} names no unit; give {option} "
            f"(--{option.replace('_', '-')}): {', '.join(known)}"
        )
    if unit not in known:
        raise CpunetError(
            f"{path}: column {column} is in {unit!r}; expected one of {', '.join(known)}"
        )
    return known[unit]
