"""Energy deposits of events in a crystal, from any source."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.simulation.geometry import FloatArray, IntArray


@dataclass(frozen=True)
class HitOptions:
    """How a file of hits is read, if it does not tell itself.

    Parameters
    ----------
    hits_detector
        Which of the file's detectors.
    origin
        X, Y and Z in mm: the point contact's centre in the file's frame.
    flip_z
        The file's point contact is on top.
    units
        Units of lengths and energies that the file does not name, as ``cm,keV``.
    """

    hits_detector: str | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    flip_z: bool = False
    units: str = ""


@dataclass(frozen=True, eq=False)
class Hits:
    """Hits of a set of events as flat arrays: event i owns ``offsets[i]:offsets[i + 1]``.

    Coordinates are in the frame of the crystal: its axis is x = y = 0, the point-contact face
    is z = 0, and z increases to the length of the crystal.

    Parameters
    ----------
    position_mm
        Positions of the hits in mm, shape ``(n_hits, 3)``.
    edep_kev
        Energy of each hit in keV.
    offsets
        Int64 array of ``n_events + 1``, from 0 to the number of hits.
    event_number
        Event numbers of the source.

    Examples
    --------
    >>> hits = Hits.of([[0, 0, 10], [5, 0, 12], [1, 1, 1]], [1000, 592.5, 2614.5], [0, 2, 3])
    >>> len(hits), hits.energy_kev
    (2, array([1592.5, 2614.5]))
    >>> hits[hits.energy_kev > 2000].z_mm
    array([1.])
    """

    position_mm: FloatArray
    edep_kev: FloatArray
    offsets: IntArray
    event_number: IntArray

    @classmethod
    def of(
        cls,
        position_mm: npt.ArrayLike,
        edep_kev: npt.ArrayLike,
        offsets: npt.ArrayLike,
        event_number: npt.ArrayLike | None = None,
    ) -> Hits:
        """Build from array-like input; positions have shape ``(n_hits, 3)``."""
        place = np.array(position_mm, float, order="C").reshape(-1, 3)
        starts = np.asarray(offsets, np.int64)
        numbers = np.arange(len(starts) - 1) if event_number is None else event_number
        return cls(place, np.asarray(edep_kev, float), starts, np.asarray(numbers, np.int64))

    @property
    def x_mm(self) -> FloatArray:
        """X of each hit in mm."""
        return self.position_mm[:, 0]

    @property
    def y_mm(self) -> FloatArray:
        """Y of each hit in mm."""
        return self.position_mm[:, 1]

    @property
    def z_mm(self) -> FloatArray:
        """Z of each hit in mm, from the face of the point contact."""
        return self.position_mm[:, 2]

    @property
    def r_mm(self) -> FloatArray:
        """Distance of each hit from the axis in mm."""
        return np.asarray(np.hypot(self.x_mm, self.y_mm))

    def __len__(self) -> int:
        """Number of events, including those without hits."""
        return len(self.offsets) - 1

    @property
    def event_of_hit(self) -> IntArray:
        """Index (not number) of the event of each hit."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))

    @property
    def energy_kev(self) -> FloatArray:
        """Energy of each event in keV, the sum over its hits."""
        return np.bincount(self.event_of_hit, self.edep_kev, len(self)).astype(np.float64)

    def __getitem__(self, which: slice | npt.NDArray[np.bool_] | IntArray) -> Hits:
        """Select events by a slice, a mask or a list of rows."""
        rows = np.arange(len(self))[which]
        counts = self.offsets[rows + 1] - self.offsets[rows]
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        # hit j of the result is hit j - offsets[i] of its original event
        take = np.arange(offsets[-1]) + np.repeat(self.offsets[rows] - offsets[:-1], counts)
        place, edep = self.position_mm[take], self.edep_kev[take]
        return Hits.of(place, edep, offsets, self.event_number[rows])

    @classmethod
    def concatenate(cls, sets: Sequence[Hits]) -> Hits:
        """Concatenate several sets, keeping the order of events."""
        counts = [np.diff(s.offsets) for s in sets]
        place, edep, number = (
            np.concatenate([getattr(s, name) for s in sets])
            for name in ("position_mm", "edep_kev", "event_number")
        )
        offsets = np.append(0, np.cumsum(np.concatenate(counts)))
        return cls.of(place, edep, offsets, number)


@dataclass(frozen=True, eq=False)
class OpenHits:
    """Number of events, and a single-use iterator over blocks of them, `merged` or as read."""

    n_events: int
    blocks: Iterator[Hits]
    merged: bool = False
