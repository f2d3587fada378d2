"""Field maps for the drift: extrapolated, refined and interpolated bilinearly in (r, z).

Nodes inside a contact carry no field. The first layers of them are extrapolated from the
germanium, so the surface of a contact lies between nodes where the potential reaches that of
the contact. FieldMaps coarser than 0.1 mm are refined by cubic splines, because bilinear
interpolation would flatten the weighting potential near the contact.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import RectBivariateSpline

from cpunet.errors import CpunetError
from cpunet.kernels import kernel
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.outline import DITCH
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.velocity import FloatArray, velocity_table

BoolArray = npt.NDArray[np.bool_]

# Columns of `DriftMaps.values`.
E_R, E_Z, WP, VOLTS = range(4)

# Maximum step of refined maps.
_FINE_MM = 0.1
# Extrapolated nodes used by the splines inside a contact and beyond a mirror plane.
_SPLINE_GHOSTS, _SPLINE_MIRROR = 8, 6


class DriftMaps(NamedTuple):
    """Field maps and velocities in the form the compiled loops take.

    ``values`` is (nr, nz, 4): field in r and z (V/cm), weighting potential, potential (V).
    ``usable`` (nr - 1, nz - 1) marks the cells in which a charge can drift, ``ditch`` the
    nodes of the ditch (nr, those up to its top). ``trapping_per_ns`` holds the trapping rates
    of electrons and holes.
    """

    values: FloatArray
    usable: BoolArray
    ditch: BoolArray
    per_mm: float
    bias_V: float
    coefficients: FloatArray
    fields_per_V_per_cm: float
    trapping_per_ns: FloatArray


def drift_maps(
    fields: FieldMaps, temperature_K: float, settings: SimulationSettings
) -> DriftMaps:
    """Prepare field maps for the drift: extrapolated into contacts, refined if coarse.

    Of the `settings`, only the velocity factors and trapping rates are used.

    Raises
    ------
    CpunetError
        If no cell of the maps has a field.
    """
    e_r, e_z, volts = fields.e_r_V_per_cm, fields.e_z_V_per_cm, fields.potential_V
    stacked = np.stack([e_r, e_z, fields.weighting_potential, volts], axis=-1).astype(float)
    # nothing drifts in the ditch, and the field is discontinuous at its walls
    ditch = np.asarray(fields.region) == DITCH
    with_field = np.isfinite(stacked).all(-1) & ~ditch & (stacked[..., :2] != 0).any(-1)
    if not with_field.any():
        raise CpunetError("the field maps hold no field; compute them again")
    bias = float(np.nanmax(stacked[..., VOLTS]))
    values, filled = with_ghost_nodes(np.where(with_field[..., None], stacked, 0.0), with_field)
    usable = _all_corners(filled) & ~_all_corners(~with_field)
    parts = math.ceil(fields.grid_mm / _FINE_MM - 1e-6)
    if parts > 1:
        for _ in range(_SPLINE_GHOSTS):
            values, filled = with_ghost_nodes(values, filled)
        values = _refined(values, parts, mirror=not stacked[:, 0, E_Z].any())
        cells = np.kron(_all_corners(ditch), np.ones((parts, parts), np.bool_))
        ditch = ~_all_corners(~np.pad(cells, 1))  # nodes at the corners of these cells
        usable = np.kron(usable, np.ones((parts, parts), np.bool_))
    table = velocity_table(temperature_K, settings.velocity_factors)
    return DriftMaps(
        values=np.ascontiguousarray(values),
        usable=usable,
        ditch=np.ascontiguousarray(ditch[:, : ditch.any(0).argmin()]),
        per_mm=parts / fields.grid_mm,
        bias_V=bias,
        coefficients=table.coefficients,
        fields_per_V_per_cm=table.fields_per_V_per_cm,
        trapping_per_ns=np.array(settings.trapping_per_ns),
    )


def _all_corners(nodes: BoolArray) -> BoolArray:
    """Cells (nr - 1, nz - 1) with all four corners in `nodes` (nr, nz)."""
    return np.asarray(nodes[:-1, :-1] & nodes[1:, :-1] & nodes[:-1, 1:] & nodes[1:, 1:])


def _refined(values: FloatArray, parts: int, *, mirror: bool) -> FloatArray:
    """Values (nr, nz, 4) on a grid `parts` times finer, by bicubic splines.

    The axis is a mirror, as is z = 0 if `mirror`: the field across it is odd.
    """
    n = _SPLINE_MIRROR
    odd_r, odd_z = np.ones(4), np.ones(4)
    odd_r[E_R] = odd_z[E_Z] = -1
    values = np.concatenate([values[n:0:-1] * odd_r, values])
    below = n if mirror else 0
    if mirror:
        values = np.concatenate([values[:, n:0:-1] * odd_z, values], axis=1)
    r, z = np.arange(values.shape[0]) - n, np.arange(values.shape[1]) - below
    fine_r = np.arange(r[-1] * parts + 1) / parts
    fine_z = np.arange(z[-1] * parts + 1) / parts
    splines = [RectBivariateSpline(r, z, values[..., k], s=0) for k in range(4)]
    return np.stack([spline(fine_r, fine_z) for spline in splines], axis=-1)


def with_ghost_nodes(values: FloatArray, given: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Extrapolate linearly by a node along r and z, then around the corners.

    A node next to two given nodes in line becomes twice the nearer value minus the farther.

    Parameters
    ----------
    values
        Array of shape ``(nr, nz, ...)``.
    given
        Boolean array (nr, nz): nodes with a value.

    Examples
    --------
    >>> values, given = np.array([[1.0], [2.0], [0.0]]), np.array([[True], [True], [False]])
    >>> with_ghost_nodes(values, given)[0].ravel().tolist()
    [1.0, 2.0, 3.0]
    """
    nr, nz = given.shape
    for _ in range(2):
        total, ways, padded = np.zeros_like(values), np.zeros(given.shape), np.pad(given, 2)
        for dr, dz in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            nearer, farther = (
                padded[2 + n * dr : 2 + n * dr + nr, 2 + n * dz : 2 + n * dz + nz]
                for n in (1, 2)
            )
            i, j = np.nonzero(nearer & farther & ~given)
            total[i, j] += 2 * values[i + dr, j + dz] - values[i + 2 * dr, j + 2 * dz]
            ways[i, j] += 1
        new = np.nonzero(ways)
        filled = values.copy()
        filled[new] = (total[new].T / ways[new]).T
        values, given = filled, given | (ways > 0)
    return values, given


@kernel(inline="always")
def in_ditch(maps: DriftMaps, p: float, q: float) -> bool:
    """Whether a place, at r and z in steps of the maps, is nearest to a node of the ditch."""
    column, row = int(p + 0.5), int(q + 0.5)
    return row < maps.ditch.shape[1] and column < len(maps.ditch) and maps.ditch[column, row]


@kernel(inline="always")
def look_up(maps: DriftMaps, r: float, z: float) -> tuple[float, float, float, float, bool]:
    """Field in r and z (V/cm), weighting potential, potential (V); False outside."""
    p, q = r * maps.per_mm, z * maps.per_mm
    nr, nz = maps.usable.shape
    # before the conversion to an index, which overflows for what is far away or no number
    if not (0.0 <= p < nr and 0.0 <= q < nz):
        return 0.0, 0.0, 0.0, 0.0, False
    i, j = int(p), int(q)
    u, v = p - i, q - j
    if not maps.usable[i, j] or in_ditch(maps, p, q):
        return 0.0, 0.0, 0.0, 0.0, False
    w00, w10, w01, w11 = (1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v
    m00, m10 = maps.values[i, j], maps.values[i + 1, j]
    m01, m11 = maps.values[i, j + 1], maps.values[i + 1, j + 1]
    er = w00 * m00[E_R] + w10 * m10[E_R] + w01 * m01[E_R] + w11 * m11[E_R]
    ez = w00 * m00[E_Z] + w10 * m10[E_Z] + w01 * m01[E_Z] + w11 * m11[E_Z]
    wp = w00 * m00[WP] + w10 * m10[WP] + w01 * m01[WP] + w11 * m11[WP]
    volts = w00 * m00[VOLTS] + w10 * m10[VOLTS] + w01 * m01[VOLTS] + w11 * m11[VOLTS]
    return er, ez, min(max(wp, 0.0), 1.0), volts, True


@kernel
def in_active_volume(maps: DriftMaps, x: float, y: float, z: float) -> bool:
    """Whether a charge released here drifts: germanium with a field, outside contacts."""
    _, _, _, potential, usable = look_up(maps, math.hypot(x, y), z)
    return usable and 0.0 < potential < maps.bias_V
