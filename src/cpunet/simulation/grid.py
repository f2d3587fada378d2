"""The grid on which potentials are solved: its nodes and their distances to contacts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation

from cpunet.errors import CpunetError
from cpunet.simulation.geometry import (
    DITCH,
    GERMANIUM,
    LI_CONTACT,
    Detector,
    FloatArray,
    RegionArray,
)

MAX_NODES = 1_500_000
PASSIVATED, DITCH_EDGE, CONTACT_EDGE = 3, 6, 7

# minimum distance to a contact, as a fraction of a step
_NEAREST = 1e-4
_BISECTIONS = 14


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes of a detector in r and z, and the lengths of the steps between them.

    ``region`` (nr, nz) is `Detector.region` at the nodes. ``r_steps`` (nr-1, nz) and
    ``z_steps`` (nr, nz-1) are 1 between two nodes of the same medium. Between a node and a
    contact they are the fraction of a step to the surface.
    """

    r_mm: FloatArray
    z_mm: FloatArray
    step_mm: float
    region: RegionArray
    r_steps: FloatArray
    z_steps: FloatArray

    @property
    def free(self) -> npt.NDArray[np.bool_]:
        """Nodes (nr, nz) with unknown potential: germanium and ditch."""
        return np.asarray(self.region > LI_CONTACT)


def make_grid(detector: Detector) -> Grid:
    """Place nodes over the crystal, up to the first ones on or beyond its surfaces.

    Raises
    ------
    CpunetError
        If ``grid_mm`` gives more nodes than fit into the memory.
    """
    h = detector.grid_mm
    nr, nz = (
        int(np.ceil(size / h - 1e-6)) + 1
        for size in (detector.crystal_radius, detector.crystal_length)
    )
    if nr * nz > MAX_NODES:
        raise CpunetError(
            f"detector {detector.name}: grid_mm {h:g} makes {nr} x {nz} nodes; "
            f"give a coarser one (at most {MAX_NODES} nodes)"
        )
    # rounded, so that 23 steps of 0.1 mm are exactly 2.3 mm
    r, z = (np.round(np.arange(n) * h, 9) for n in (nr, nz))
    rr, zz = np.meshgrid(r, z, indexing="ij")
    region = detector.region(rr, zz)
    return Grid(
        r_mm=r,
        z_mm=z,
        step_mm=h,
        region=region,
        r_steps=_steps(detector, rr, zz, region, axis=0),
        z_steps=_steps(detector, rr, zz, region, axis=1),
    )


def _steps(
    detector: Detector, rr: FloatArray, zz: FloatArray, region: RegionArray, axis: int
) -> FloatArray:
    """Fractions of the steps along `axis` that lie outside the contacts."""
    low, high = _ends(region, axis)
    steps = np.ones(low.shape)
    crossing = (low <= LI_CONTACT) != (high <= LI_CONTACT)
    # ends (low and high), coordinates (r and z), steps that cross a surface
    nodes = np.stack([_ends(rr, axis), _ends(zz, axis)], axis=1)[..., crossing]
    # start at the node outside the contact
    start, end = np.where(low[crossing] <= LI_CONTACT, nodes[::-1], nodes)
    outside, inside = np.zeros(crossing.sum()), np.ones(crossing.sum())
    for _ in range(_BISECTIONS):
        middle = (outside + inside) / 2
        hit = detector.region(*(start + middle * (end - start))) <= LI_CONTACT
        inside = np.where(hit, middle, inside)
        outside = np.where(hit, outside, middle)
    # a surface on the node itself counts as a full step: exact where grid and contact meet
    steps[crossing] = np.clip(np.where(inside > 1 - 2 * _NEAREST, 1, inside), _NEAREST, 1)
    return steps


def _ends(values: npt.NDArray[Any], axis: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    return (values[:-1], values[1:]) if axis == 0 else (values[:, :-1], values[:, 1:])


def point_types(grid: Grid) -> RegionArray:
    """Type of each node (nr, nz), in fieldgen's numbering.

    0 point contact, 1 lithium contact or outside, 2 germanium, 3 passivated face
    (z = 0), 5 ditch, 6 germanium next to the ditch, 7 germanium next to a contact.
    """
    types = grid.region.copy()
    germanium = grid.region == GERMANIUM
    # a dilation adds the four neighbours of each node
    types[germanium & binary_dilation(grid.region == DITCH)] = DITCH_EDGE
    types[germanium & binary_dilation(~grid.free)] = CONTACT_EDGE
    types[germanium[:, 0], 0] = PASSIVATED
    return types
