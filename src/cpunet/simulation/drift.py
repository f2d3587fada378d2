"""Drift of one electron and one hole through the field maps, step by step.

The maps are bilinear in (r, z).  Nodes inside a contact carry no field; the first layer
of them is extrapolated from the germanium, so that a contact's surface lies where the
potential reaches the contact's, between the nodes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from numba import njit

from cpunet.errors import CpunetError
from cpunet.simulation.cloud import cloud_after_step
from cpunet.simulation.geometry import DITCH
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.velocity import (
    ELECTRON,
    HOLE,
    FloatArray,
    carrier_velocity,
    velocity_table,
)

# Columns of `DriftMaps.values`.
E_R, E_Z, WP, POTENTIAL = range(4)

# A carrier is collected where its signal can no more change by this share of full scale.
_COLLECTED = 5e-5
# Holes that creep along the contact's edge are collected there as well.
_AT_CONTACT, _CREEPING = 0.999, 2e-4


class Maps(Protocol):
    """What a drift needs of `cpunet.simulation.fields.FieldMaps`."""

    @property
    def grid_mm(self) -> float: ...
    @property
    def potential_V(self) -> FloatArray: ...
    @property
    def e_r_V_per_cm(self) -> FloatArray: ...
    @property
    def e_z_V_per_cm(self) -> FloatArray: ...
    @property
    def weighting_potential(self) -> FloatArray: ...
    @property
    def point_type(self) -> npt.NDArray[np.int8]: ...
    @property
    def temperature_K(self) -> float: ...


class DriftMaps(NamedTuple):
    """Field maps and velocities as the compiled loops want them.

    ``values`` is (nr, nz, 4): field in r and z (V/cm), weighting potential, potential
    (V); ``usable`` (nr - 1, nz - 1) marks the cells in which a charge can drift.
    """

    values: FloatArray
    usable: npt.NDArray[np.bool_]
    per_mm: float
    bias_V: float
    coefficients: FloatArray
    fields_per_V_per_cm: float


@dataclass(frozen=True, eq=False)
class DriftPaths:
    """Positions (n, steps, 3) in mm of both carriers at every step, NaN after the end."""

    electrons: FloatArray
    holes: FloatArray


def drift_maps(fields: Maps) -> DriftMaps:
    """Arrange maps for the drift and extrapolate them one node into the contacts.

    Raises
    ------
    CpunetError
        If no cell of the maps has a field.
    """
    stacked = np.stack(
        [
            fields.e_r_V_per_cm,
            fields.e_z_V_per_cm,
            fields.weighting_potential,
            fields.potential_V,
        ],
        axis=-1,
    ).astype(np.float64)
    # nothing drifts in the ditch, and the field jumps at its walls
    with_field = np.isfinite(stacked).all(-1) & (np.asarray(fields.point_type) != DITCH)
    bias = float(np.nanmax(stacked[..., POTENTIAL]))
    with_field &= (stacked[..., :2] != 0).any(-1)
    if not with_field.any():
        raise CpunetError("the field maps hold no field; compute them again")
    values, known = with_ghost_nodes(np.where(with_field[..., None], stacked, 0.0), with_field)
    corners = [known[:-1, :-1], known[1:, :-1], known[:-1, 1:], known[1:, 1:]]
    inside = [
        with_field[:-1, :-1],
        with_field[1:, :-1],
        with_field[:-1, 1:],
        with_field[1:, 1:],
    ]
    table = velocity_table(fields.temperature_K)
    return DriftMaps(
        values=np.ascontiguousarray(values),
        usable=np.logical_and.reduce(corners) & np.logical_or.reduce(inside),
        per_mm=1.0 / fields.grid_mm,
        bias_V=bias,
        coefficients=table.coefficients,
        fields_per_V_per_cm=table.fields_per_V_per_cm,
    )


def with_ghost_nodes(
    values: FloatArray, known: npt.NDArray[np.bool_]
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Extrapolate linearly by one node along r and z, then around the corners.

    Parameters
    ----------
    values
        Array of shape ``(nr, nz, ...)``.
    known
        Boolean array (nr, nz): nodes with a value of their own.
    """
    for _ in range(2):
        total = np.zeros_like(values)
        ways = np.zeros(known.shape)
        for axis in (0, 1):
            for near, far in ((1, 2), (-1, -2)):
                usable = _shifted(known, near, axis) & _shifted(known, far, axis) & ~known
                guess = 2 * _shifted(values, near, axis) - _shifted(values, far, axis)
                total[usable] += guess[usable]
                ways += usable
        found = ways > 0
        filled = values.copy()
        filled[found] = (total[found].T / ways[found]).T
        values, known = filled, known | found
    return values, known


def _shifted(array: npt.NDArray[Any], by: int, axis: int) -> npt.NDArray[Any]:
    """The array whose entry i is the old entry i + by; zeros come in at the end."""
    out = np.zeros_like(array)
    n = array.shape[axis]
    target = slice(0, n - by) if by > 0 else slice(-by, n)
    source = slice(by, n) if by > 0 else slice(0, n + by)
    index = (slice(None),) * axis
    out[(*index, target)] = array[(*index, source)]
    return out


@njit(cache=True, nogil=True, inline="always")
def look_up(maps: DriftMaps, r: float, z: float) -> tuple[float, float, float, float, bool]:
    """Field in r and z (V/cm), weighting potential, potential (V); False outside."""
    p, q = r * maps.per_mm, z * maps.per_mm
    i, j = int(p), int(q)
    if not (p >= 0.0 and q >= 0.0) or i >= maps.usable.shape[0] or j >= maps.usable.shape[1]:
        return 0.0, 0.0, 0.0, 0.0, False
    if not maps.usable[i, j]:
        return 0.0, 0.0, 0.0, 0.0, False
    u, v = p - i, q - j
    w00, w10, w01, w11 = (1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v
    m00, m10 = maps.values[i, j], maps.values[i + 1, j]
    m01, m11 = maps.values[i, j + 1], maps.values[i + 1, j + 1]
    er = w00 * m00[E_R] + w10 * m10[E_R] + w01 * m01[E_R] + w11 * m11[E_R]
    ez = w00 * m00[E_Z] + w10 * m10[E_Z] + w01 * m01[E_Z] + w11 * m11[E_Z]
    wp = w00 * m00[WP] + w10 * m10[WP] + w01 * m01[WP] + w11 * m11[WP]
    potential = (
        w00 * m00[POTENTIAL]
        + w10 * m10[POTENTIAL]
        + w01 * m01[POTENTIAL]
        + w11 * m11[POTENTIAL]
    )
    return er, ez, min(max(wp, 0.0), 1.0), potential, True


@njit(cache=True, nogil=True)
def in_active_volume(maps: DriftMaps, x: float, y: float, z: float) -> bool:
    """Whether a charge set free here drifts: germanium with a field, no contact."""
    _, _, _, potential, usable = look_up(maps, math.hypot(x, y), z)
    return usable and 0.0 < potential < maps.bias_V


@njit(cache=True, nogil=True)
def drift(
    maps: DriftMaps,
    carrier: int,
    start: tuple[float, float, float],
    step_ns: float,
    cloud: tuple[float, float, float],
    signal: FloatArray,
    path: FloatArray,
) -> tuple[int, bool, float, float]:
    """Move one charge until it is collected; add what it induces to `signal`.

    Parameters
    ----------
    cloud
        FWHM in mm at the start (0: a point), diffusion constant D/(v/E) and repulsion
        constant (see `cpunet.simulation.cloud`).
    signal
        Record of one value per step, to which the weighting potential gained (hole) or
        lost (electron) is added; the caller fills the rest of the record.
    path
        Positions (steps, 3) to fill, or an empty array.

    Returns
    -------
    tuple
        Last step, whether the charge was collected, FWHM (mm) and speed (mm/ns) there.
    """
    x, y, z = start
    sign = 1.0 if carrier == HOLE else -1.0
    size, diffusion, repulsion = cloud
    first = last = speed = 0.0
    n = len(signal)
    k, collected = 0, False
    while k < n:
        r = math.hypot(x, y)
        er, ez, wp, potential, usable = look_up(maps, r, z)
        if not usable:
            # beyond the contact's surface: the rest of the signal comes in this step
            wp = 1.0 if last > 0.3 else 0.0
            collected = True
        if k == 0:
            first = wp
        signal[k] += sign * (wp - first)
        if len(path) > 0:
            path[k, 0], path[k, 1], path[k, 2] = x, y, z
        if carrier == HOLE:
            at_edge = k > 0 and wp >= _AT_CONTACT and wp - last < _CREEPING
            collected |= 1.0 - wp < _COLLECTED or at_edge or (potential <= 0.0 and usable)
        else:
            collected |= wp < _COLLECTED or potential >= maps.bias_V
        last = wp
        if collected:
            break
        per_r = er / r if r > 0.0 else 0.0
        vx, vy, vz, strength, _, slope = carrier_velocity(
            maps.coefficients, maps.fields_per_V_per_cm, carrier, per_r * x, per_r * y, ez
        )
        now = math.sqrt(vx * vx + vy * vy + vz * vz)
        if size > 0.0:
            size = cloud_after_step(
                size, now, speed, strength, slope, diffusion, repulsion, step_ns, k
            )
        speed = now
        if k == n - 1:
            break
        # no charge leaves through the passivated face: it slides along
        x, y, z = x + vx * step_ns, y + vy * step_ns, max(z + vz * step_ns, 0.0)
        k += 1
    rest = sign * (last - first)
    for later in range(k + 1, n):
        signal[later] += rest
    return k, collected, size, speed


def drift_paths(
    fields: Maps,
    x_mm: npt.ArrayLike,
    y_mm: npt.ArrayLike,
    z_mm: npt.ArrayLike,
    settings: SimulationSettings,
) -> DriftPaths:
    """Trajectories of both carriers from each starting point, one position per step."""
    start = np.stack(np.broadcast_arrays(x_mm, y_mm, z_mm), axis=-1).astype(np.float64)
    maps = drift_maps(fields)
    paths = np.full((2, len(start), settings.n_steps, 3), np.nan)
    _fill_paths(maps, start.reshape(-1, 3), settings.step_ns, paths)
    return DriftPaths(electrons=paths[ELECTRON], holes=paths[HOLE])


@njit(cache=True, nogil=True)
def _fill_paths(maps: DriftMaps, start: FloatArray, step_ns: float, paths: FloatArray) -> None:
    signal = np.zeros(paths.shape[2])
    for i in range(len(start)):
        here = (start[i, 0], start[i, 1], start[i, 2])
        if in_active_volume(maps, here[0], here[1], here[2]):
            for carrier in range(2):
                drift(maps, carrier, here, step_ns, (0.0, 0.0, 0.0), signal, paths[carrier, i])
