"""Merge hits that lie close together, so that fewer charges need to be drifted."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hits import Hits

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


def cluster_hits(
    hits: Hits, distance_mm: float, alone: npt.NDArray[np.bool_] | None = None
) -> Hits:
    r"""Merge hits of an event that are closer together than a distance.

    Single linkage: hits connected by a chain of neighbours at most `distance_mm` apart become
    one hit with the sum of their energies at their energy-weighted mean position,

    .. math:: E = \sum_i E_i, \qquad \mathbf{x} = \frac{1}{E} \sum_i E_i \mathbf{x}_i.

    Clusters keep the order of their first hits.

    Parameters
    ----------
    hits
        Events as read or simulated.
    distance_mm
        Maximum distance between neighbours in mm. 0 merges only hits at the same position.
    alone
        Which hits are never merged; by default none.

    Examples
    --------
    >>> hits = Hits.of([[0, 0, 1], [0, 0, 2], [0, 0, 9]], [100, 300, 50], [0, 3])
    >>> sites = cluster_hits(hits, distance_mm=1.5)
    >>> sites.z_mm, sites.edep_kev
    (array([1.75, 9.  ]), array([400.,  50.]))
    """
    near = float(distance_mm) ** 2  # always a float, so that the loop is compiled only once
    alone = np.zeros(len(hits.edep_kev), np.bool_) if alone is None else alone
    merged, offsets = _merge(hits.position_mm, hits.edep_kev, hits.offsets, alone, near)
    return Hits.of(merged[:, :3], merged[:, 3].copy(), offsets, hits.event_number)


def merge_hits(hits: Hits, detector: Detector, distance_mm: float) -> Hits:
    """Merge nearby hits (see `cluster_hits`), but not across the edge of the active germanium.

    A hit in the lithium layer gives no signal. Merged with neighbours in the bulk it would
    give one, or suppress theirs: at 0.1 mm this changed the collected energy of a gamma event
    by 4.5 keV on average.
    """
    if distance_mm == 0:
        return hits
    outside = ~detector.active(hits.r_mm, hits.z_mm)
    order = np.lexsort((outside, hits.event_of_hit))  # the last hits of each event
    sorted_hits = hits.position_mm[order], hits.edep_kev[order]
    hits = Hits.of(*sorted_hits, hits.offsets, hits.event_number)
    return cluster_hits(hits, distance_mm, outside[order])


@kernel
def _merge(
    position: Array,
    energy: Array,
    offsets: Integers,
    alone: npt.NDArray[np.bool_],
    distance2: float,
) -> tuple[Array, Integers]:
    """Clusters as rows (x, y, z, energy), and the offsets of the events."""
    merged = np.zeros((len(energy), 4))
    new_offsets = np.zeros_like(offsets)
    label = np.empty(len(energy), np.int64)
    queue = np.empty(len(energy), np.int64)
    n = 0
    for event in range(len(offsets) - 1):
        start, end = offsets[event], offsets[event + 1]
        label[start:end] = -1
        for first in range(start, end):
            if label[first] >= 0:
                continue
            label[first] = n
            queue[0] = first
            done, waiting = 0, 1
            while done < waiting and not alone[first]:
                mine = queue[done]
                done += 1
                for other in range(first + 1, end):
                    if label[other] >= 0 or alone[other]:
                        continue
                    square = 0.0
                    for axis in range(3):
                        square += (position[mine, axis] - position[other, axis]) ** 2
                    if square <= distance2:
                        label[other] = n
                        queue[waiting] = other
                        waiting += 1
            row = merged[n]
            for member in queue[:waiting]:
                row[3] += energy[member]
            for axis in range(3):
                # relative to the first, so that equal positions are preserved exactly
                origin = position[first, axis]
                shift = 0.0
                for member in queue[:waiting]:
                    shift += energy[member] * (position[member, axis] - origin)
                row[axis] = origin + (shift / row[3] if row[3] > 0.0 else 0.0)
            n += 1
        new_offsets[event + 1] = n
    return merged[:n], new_offsets
