"""Steps of a simulation as read, and their conversion to hits in the crystal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.simulation.hit_readers.grouping import event_of_step
from cpunet.simulation.hits import FARTHEST_MM, MAX_KEV, Hits

FloatArray = npt.NDArray[np.float64]

_MAX_NUMBER = 2.0**62
_MM = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "µm": 1e-3}
_KEV = {"keV": 1.0, "MeV": 1e3, "eV": 1e-3, "GeV": 1e6}
_NS = {"ns": 1.0, "us": 1e3, "µs": 1e3, "ms": 1e6, "s": 1e9, "ps": 1e-3}
# the largest deposit of any source is above the first, the median event below the second
_LEAST_KEV, _MOST_KEV = 5.0, 1e5


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

    def factor(self, role: str, path: Path, column: str, named: str) -> float:
        """Conversion factor of a column with the unit `named` to keV, ns or mm.

        `role` is ``"edep"``, ``"time"`` or an axis. Times without a unit are in ns, Geant4's
        own.

        Raises
        ------
        CpunetError
            If the unit is unknown, or nobody tells it.
        """
        given, known, option = {
            "edep": (self.energy, _KEV, "energy_unit"),
            "time": ("ns", _NS, ""),
        }.get(role, (self.length, _MM, "length_unit"))
        unit = named or given
        if unit is None:
            raise CpunetError(
                f"{path}: column {column} names no unit; give `{option}`: {', '.join(known)}"
            )
        if unit not in known:
            raise CpunetError(
                f"{path}: column {column} is in {unit!r}; expected one of {', '.join(known)}"
            )
        return known[unit]


@dataclass(frozen=True)
class Steps:
    """Steps relative to the detector's origin in the frame of a file; events in any order.

    `time_ns` is None where the file tells no times.
    """

    event: npt.NDArray[np.int64]
    position_mm: FloatArray
    edep_kev: FloatArray
    time_ns: FloatArray | None = None

    def __getitem__(self, kept: npt.NDArray[np.bool_]) -> Steps:
        """Steps that are `kept`."""
        time = None if self.time_ns is None else self.time_ns[kept]
        return Steps(self.event[kept], self.position_mm[kept], self.edep_kev[kept], time)

    def moved(self, by_mm: FloatArray) -> Steps:
        """Steps at positions shifted by a vector."""
        return replace(self, position_mm=self.position_mm + by_mm)


@dataclass(frozen=True)
class ReadHits:
    """Hits of a file, and the number of steps without energy deposit, which are omitted."""

    hits: Hits
    steps_without_energy: int


def to_hits(
    path: Path,
    steps: Steps,
    transform: Transform,
    window_us: float,
    first_free: int | None = None,
) -> ReadHits:
    """Group steps by event (see `event_of_step`), in the order of the file.

    Positions are moved to the frame of the crystal. An event whose number an earlier one has
    gets a new one: `first_free` and those after it, by default from the largest on.

    Raises
    ------
    CpunetError
        If a step has no finite position, time or energy, or a negative energy.
    """
    # written so that NaN fails
    placed = (np.abs(steps.position_mm) <= FARTHEST_MM).all(axis=1)
    bad = ~(placed & (steps.edep_kev >= 0) & (steps.edep_kev <= MAX_KEV))
    if steps.time_ns is not None:
        bad |= ~np.isfinite(steps.time_ns)
    if bad.any():
        event = steps.event[np.argmax(bad)]
        raise CpunetError(
            f"{path}: event {event}: a step has no finite position or time, or no energy of at "
            f"least 0 (nor may it lie {FARTHEST_MM / 1e6:g} km away or have "
            f"{MAX_KEV / 1e9:g} TeV); remove the event or simulate again"
        )
    if first_free is None:
        first_free = int(steps.event.max(initial=-1)) + 1
    with_energy = steps.edep_kev > 0
    kept = steps[with_energy]
    found = event_of_step(kept.event, kept.time_ns, window_us)
    _, first, label = np.unique(found, return_index=True, return_inverse=True)
    in_file = np.argsort(first)
    rank = np.empty_like(in_file)
    rank[in_file] = np.arange(len(in_file))
    # steps of one event need not be adjacent, as in files merged from several threads
    order = np.argsort(rank[label], kind="stable")
    counts = np.bincount(rank[label], minlength=len(first))
    numbers = kept.event[first[in_file]]
    again = np.ones(len(numbers), bool)
    again[np.unique(numbers, return_index=True)[1]] = False
    numbers[again] = first_free + np.arange(again.sum())
    hits = Hits.of(
        transform.apply(kept.position_mm[order]),
        kept.edep_kev[order],
        np.concatenate([[0], np.cumsum(counts)]),
        numbers,
    )
    return ReadHits(hits, int((~with_energy).sum()))


def require_some(path: Path, n_events: int) -> None:
    """Raise a `CpunetError` if there is no event with a deposit."""
    if not n_events:
        raise CpunetError(f"{path}: no step deposits energy; check the detector's name")


def require_physics(path: Path, energy_kev: FloatArray) -> None:
    """Raise a `CpunetError` if the energies of events are those of another unit."""
    if len(energy_kev) and not (
        energy_kev.max() >= _LEAST_KEV and np.median(energy_kev) <= _MOST_KEV
    ):
        raise CpunetError(
            f"{path}: the energies of events, up to {energy_kev.max():.4g} keV, are no "
            "deposits in germanium; correct the unit of their column (is it in MeV or eV?), or "
            "give `energy_unit` if it names none"
        )


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
