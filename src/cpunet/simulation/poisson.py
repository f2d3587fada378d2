r"""Poisson's equation in a detector, by finite volumes and a sparse direct solver.

.. math:: \nabla \cdot (\varepsilon \nabla V) = -\rho

Each node owns the ring within half a step of it. Gauss's law for the ring, per unit angle, is

.. math:: \sum_f A_f \varepsilon_f (V - V_f) / d_f = \int \rho\,r\,dr\,dz,

where the distance :math:`d_f` ends at the surface of a contact (Gibou et al., J. Comput.
Phys. 176 (2002) 205). On the axis this becomes
:math:`V = (V_{z+} + V_{z-} + 4 V_r)/6 + \rho h^2 / 6\varepsilon`. Faces on z = 0 carry no flux
except to a grounded plane. The matrix is symmetric and factorised once, so each further set of
charges and electrode potentials takes only hundredths of a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.constants import elementary_charge, epsilon_0
from scipy.ndimage import label, minimum_filter
from scipy.sparse.linalg import splu

from cpunet.errors import CpunetError
from cpunet.simulation.geometry import Detector, FloatArray, RegionArray
from cpunet.simulation.outline import GERMANIUM, LI_CONTACT, POINT_CONTACT

MAX_NODES = 1_500_000
# minimum distance to a contact, as a fraction of a step
_NEAREST = 1e-4
_BISECTIONS = 14
# V: a pocket this shallow holds no charge (about kT/e at 90 K), and is not resolved by the
# grid
POCKET_DEPTH_V = 0.01
HIGHEST_BIAS_V = 20_000.0
_RESOLUTION_V = 0.5


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes of a detector in r and z, and the lengths of the steps between them.

    ``region`` (nr, nz) is `Detector.region` at the nodes. ``r_steps`` (nr-1, nz) and
    ``z_steps`` (nr, nz-1) are 1 between two nodes of the same medium. Between a node and a
    contact they are the fraction of a step to the surface.
    """

    r_mm: FloatArray
    z_mm: FloatArray
    grid_mm: float
    region: RegionArray
    r_steps: FloatArray
    z_steps: FloatArray


def make_grid(detector: Detector) -> Grid:
    """Place nodes over the crystal, up to the first ones on or beyond its surfaces.

    Raises
    ------
    CpunetError
        If ``grid_mm`` gives more nodes than fit into the memory.
    """
    h, sizes = detector.grid_mm, (detector.crystal_radius, detector.crystal_length)
    nr, nz = (int(np.ceil(size / h - 1e-6)) + 1 for size in sizes)
    if nr * nz > MAX_NODES:
        text = f"detector {detector.name}: grid_mm {h:g} makes {nr} x {nz} nodes"
        raise CpunetError(text, f"give a coarser one (at most {MAX_NODES} nodes)")
    # rounded, so that 23 steps of 0.1 mm are exactly 2.3 mm
    r, z = (np.round(np.arange(n) * h, 9) for n in (nr, nz))
    rr, zz = np.meshgrid(r, z, indexing="ij")
    region = detector.region(rr, zz)
    r_steps = _steps(detector, rr, zz, region)
    z_steps = _steps(detector, rr.T, zz.T, region.T).T
    return Grid(r_mm=r, z_mm=z, grid_mm=h, region=region, r_steps=r_steps, z_steps=z_steps)


def _steps(detector: Detector, r: FloatArray, z: FloatArray, region: RegionArray) -> FloatArray:
    """Fractions of the steps along the first axis that lie outside the contacts."""
    contact = region <= LI_CONTACT
    crossing = contact[:-1] != contact[1:]
    nodes = np.stack([r, z])
    low, high = nodes[:, :-1][:, crossing], nodes[:, 1:][:, crossing]
    # start at the node outside the contact
    start, end = np.where(contact[:-1][crossing], [high, low], [low, high])
    outside, inside = np.zeros(crossing.sum()), np.ones(crossing.sum())
    for _ in range(_BISECTIONS):
        middle = (outside + inside) / 2
        hit = detector.region(*(start + middle * (end - start))) <= LI_CONTACT
        inside = np.where(hit, middle, inside)
        outside = np.where(hit, outside, middle)
    # a surface on the node itself counts as a full step: exact where grid and contact meet
    steps = np.ones(crossing.shape)
    steps[crossing] = np.clip(np.where(inside > 1 - 2 * _NEAREST, 1, inside), _NEAREST, 1)
    return steps


EPSILON_GERMANIUM = 16.0

# e / epsilon_0 times 1e10 / cm3, in V / mm2, and the permittivity in pF / mm
VOLT_PER_MM2 = elementary_charge / epsilon_0 * 1e16 * 1e-6
PF_PER_MM = epsilon_0 * 1e12 * 1e-3


@dataclass(frozen=True, eq=False)
class Potentials(Grid):
    """Contributions of electrodes and charges to the potential, at the nodes of a grid.

    Parameters
    ----------
    weighting_potential
        Potential with 1 on the point contact and 0 on the lithium.
    bias
        Potential with 1 on the lithium and 0 on the point contact.
    impurities, tilt, surface
        Potentials in V with all electrodes at 0: of the impurities, neither scaled nor tilted,
        of a unit of their tilt, and of the charge of the passivated surface.
    capacitance_pF
        Capacitance of the point contact in pF.
    """

    weighting_potential: FloatArray
    bias: FloatArray
    impurities: FloatArray
    tilt: FloatArray
    surface: FloatArray
    capacitance_pF: float

    def total_V(self, bias_V: float, impurity_scale: float, impurity_tilt: float) -> FloatArray:
        r"""Potential (nr, nz) in V for a bias in V and scaled and tilted impurities.

        .. math:: V = b\, w + s\, u + t\, v + q

        The tilt is in 1e10/cm4. Where the detector is not depleted, this is not the true
        potential.
        """
        total = bias_V * self.bias + impurity_scale * self.impurities + self.surface
        return total + impurity_tilt * self.tilt if impurity_tilt else total

    def depletion(self, impurity_scale: float = 1.0, impurity_tilt: float = 0.0) -> float:
        """Smallest bias in V that depletes the detector; infinite if none up to 20 kV does."""
        low, high = 0.0, HIGHEST_BIAS_V
        charges = self.total_V(0.0, impurity_scale, impurity_tilt)
        if has_pocket(high * self.bias + charges, self.region):
            return float("inf")
        if not has_pocket(charges, self.region):
            return 0.0
        while high - low > _RESOLUTION_V:
            middle = (low + high) / 2
            pocket = has_pocket(middle * self.bias + charges, self.region)
            low, high = (middle, high) if pocket else (low, middle)
        return high


def solve_potentials(detector: Detector, grid: Grid) -> Potentials:
    r"""Solve for both electrodes and for all charges on the nodes of `grid`.

    The capacitance follows from the energy of the weighting field,

    .. math:: C = \int \varepsilon\, |\nabla \phi_w|^2\, dV.

    Examples
    --------
    The potentials of the two electrodes add up to 1 everywhere.

    >>> from cpunet.simulation.geometry_readers import read_detector
    >>> from cpunet.simulation.poisson import make_grid
    >>> detector = read_detector("ppc", ["grid_mm=0.5"])
    >>> grid = make_grid(detector)
    >>> parts = solve_potentials(detector, grid)
    >>> total = parts.weighting_potential + parts.bias
    >>> bool(abs(total - 1)[grid.region >= GERMANIUM].max() < 1e-9)
    True
    """
    # conductances of the steps per unit angle in mm: area times permittivity over length
    # a step in r crosses the upper half of the cell below it and the lower of the one above
    h, n_z = grid.grid_mm, len(grid.z_mm)
    epsilon = 1 + (EPSILON_GERMANIUM - 1) * _germanium_in_cells(detector, grid)
    middle = (grid.r_mm[:-1] + grid.r_mm[1:]) / 2
    between = on_nodes(epsilon / 2, epsilon / 2, axis=1)
    r_flux = between * middle[:, np.newaxis] / grid.r_steps
    inner, outer = _half_rings(grid)
    z_flux = on_nodes(epsilon * inner[1:] / h, epsilon * outer[:-1] / h, axis=0) / grid.z_steps
    gap = detector.vacuum_gap
    to_ground = (inner + outer)[:, 0] / gap if gap else np.zeros(len(grid.r_mm))
    free = grid.region > LI_CONTACT  # nodes with unknown potential: germanium and ditch
    above, below = np.pad(z_flux, ((0, 0), (0, 1))), np.pad(z_flux, ((0, 0), (1, 0)))
    diagonal = on_nodes(r_flux, r_flux, axis=0) + above + below
    diagonal[:, 0] += to_ground
    bands = [r_flux.ravel(), above.ravel()[:-1]]
    neighbours = sp.diags_array(2 * bands, offsets=(n_z, 1, -n_z, -1)).tocsr()
    rows = free.ravel()
    matrix = (sp.diags_array(diagonal.ravel()) - neighbours)[rows][:, rows].tocsc()
    # symmetric and diagonally dominant: no pivoting, and an ordering that exploits it
    options = {"SymmetricMode": True}
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)

    def solved(boundary: FloatArray, charge: FloatArray) -> FloatArray:
        # potentials of contacts are given: their columns are moved to the right-hand side
        potential = boundary.copy()
        given = (neighbours @ boundary.ravel()).reshape(free.shape)
        potential[free] = factors.solve((charge + given)[free])
        return potential

    nothing = np.zeros(free.shape)
    weighting = solved((grid.region == POINT_CONTACT).astype(float), nothing)
    bias = solved((grid.region == LI_CONTACT).astype(float), nothing)
    impurity = detector.impurity_1e10_per_cm3(grid.r_mm[:, np.newaxis], grid.z_mm)
    impurities = solved(nothing, charges(detector, grid, impurity))
    unit_tilt = (grid.z_mm - detector.crystal_length / 2) / 10
    tilt = solved(nothing, charges(detector, grid, unit_tilt))
    surface = nothing
    if detector.surface_charge_1e10_per_cm2:
        surface = solved(nothing, surface_charges(detector, grid))
    energy = (r_flux * np.diff(weighting, axis=0) ** 2).sum()
    energy += (z_flux * np.diff(weighting, axis=1) ** 2).sum()
    energy += (to_ground * weighting[:, 0] ** 2).sum()
    return Potentials(
        **vars(grid),
        weighting_potential=weighting,
        bias=bias,
        impurities=impurities,
        tilt=tilt,
        surface=surface,
        capacitance_pF=float(2 * np.pi * PF_PER_MM * energy),
    )


def charges(detector: Detector, grid: Grid, impurity: FloatArray) -> FloatArray:
    r"""Charge of each ring over the vacuum permittivity, per rad, in V mm.

    .. math:: Q = \int \frac{e N}{\varepsilon_0}\, r\, dr\, dz

    Parameters
    ----------
    detector, grid
        Detector and nodes.
    impurity
        Net impurity at the nodes in 1e10/cm3.
    """
    germanium = _germanium_in_cells(detector, grid)
    if detector.siggen_conventions:
        # in fieldgen the ditch has 1/16 of the charge density of germanium
        germanium = germanium + (1 - germanium) / EPSILON_GERMANIUM
    inner, outer = _half_rings(grid)
    h = grid.grid_mm
    half = on_nodes(germanium * inner[1:] * h / 2, germanium * outer[:-1] * h / 2, axis=0)
    return np.asarray(VOLT_PER_MM2 * impurity * on_nodes(half, half, axis=1))


def surface_charges(detector: Detector, grid: Grid) -> FloatArray:
    """Charge of each ring on the passivated germanium, in the units of `charges`.

    In fieldgen this is the germanium on z = 0; the ditch carries none. With the exact geometry
    the walls and the floor of the ditch are passivated as well.

    Raises
    ------
    CpunetError
        If the ditch leaves no germanium on z = 0 and, as in fieldgen, carries no charge.
    """
    inner, outer = _half_rings(grid)
    face = np.zeros(grid.region.shape)
    if detector.siggen_conventions:
        face[:, 0] = (inner + outer)[:, 0] * (grid.region[:, 0] == GERMANIUM)
        if not face.any():
            raise CpunetError(
                f"detector {detector.name}: the ditch leaves no germanium on z = 0 for "
                "surface_charge_1e10_per_cm2; give siggen_conventions=false, which also "
                "charges the walls of the ditch"
            )
    else:
        germanium = _germanium_in_cells(detector, grid)
        # below z = 0 and in the ditch is no germanium
        floor = np.abs(np.diff(germanium, axis=1, prepend=0))
        face[:, :-1] = on_nodes(floor * inner[1:], floor * outer[:-1], axis=0)
        half_wall = np.abs(np.diff(germanium, axis=0)) * grid.grid_mm / 2
        half_wall *= grid.r_mm[1:-1, np.newaxis]
        face[1:-1, 1:] += half_wall
        face[1:-1, :-1] += half_wall
    # 1e10 / cm2 over 1 mm is 10 times 1e10 / cm3
    return np.asarray(10 * VOLT_PER_MM2 * detector.surface_charge_1e10_per_cm2 * face)


def on_nodes(above: FloatArray, below: FloatArray, axis: int) -> FloatArray:
    """Sums at the nodes between cells along an axis: of the cell before, and of that after."""
    before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
    before[axis], after[axis] = (1, 0), (0, 1)
    return np.asarray(np.pad(above, before) + np.pad(below, after))


def _half_rings(grid: Grid) -> tuple[FloatArray, FloatArray]:
    """Area (nr, 1) per unit angle, in mm2, of each half ring towards the axis and away."""
    r, h = grid.r_mm[:, np.newaxis], grid.grid_mm
    inner = np.where(r > 0, (r**2 - (r - h / 2) ** 2) / 2, 0)
    return inner, ((r + h / 2) ** 2 - r**2) / 2


def _germanium_in_cells(detector: Detector, grid: Grid) -> FloatArray:
    """Fraction (nr-1, nz-1) of each cell between four nodes that lies outside the ditch."""
    inner, outer, depth = detector.ditch_walls
    in_r, in_z = (
        np.maximum(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0) / grid.grid_mm
        for edges, low, high in ((grid.r_mm, inner, outer), (grid.z_mm, 0.0, depth))
    )
    return np.asarray(1 - in_r[:, np.newaxis] * in_z)


def has_pocket(potential: FloatArray, region: RegionArray) -> bool:
    """Whether `potential` (nr, nz), in V, keeps holes from reaching an electrode.

    Examples
    --------
    >>> import numpy as np
    >>> r, z = np.meshgrid(np.arange(9), np.arange(9), indexing="ij")
    >>> region = np.where(z == 0, 0, 2)
    >>> has_pocket(z * 10.0, region), has_pocket((z - 4.0) ** 2, region)
    (False, True)
    """
    minima = potential <= minimum_filter(potential, size=3, mode="nearest")
    minima &= region == GERMANIUM
    where = np.argwhere(minima)
    for row, column in where[np.argsort(potential[minima])]:  # a true pocket is deep
        start = potential[row, column]
        basins, _ = label(potential <= start + POCKET_DEPTH_V, np.ones((3, 3)))
        basin = basins == basins[row, column]
        # below that level it leads neither to a contact nor to a lower node
        if (region[basin] >= GERMANIUM).all() and (potential[basin] >= start).all():
            return True
    return False
