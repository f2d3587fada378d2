"""Drift of one electron and one hole through the field maps by explicit Euler steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel
from cpunet.simulation.cloud import cloud_after_step
from cpunet.simulation.field_lookup import (
    DriftMaps,
    Maps,
    drift_maps,
    in_active_volume,
    look_up,
)
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.velocity import (
    ELECTRON,
    HOLE,
    FloatArray,
    carrier_velocity,
)

# A carrier is collected once its signal can change by less than this fraction of full scale.
_COLLECTED = 5e-5
# Holes that move slowly along the edge of the contact also count as collected.
_AT_CONTACT, _CREEPING = 0.999, 2e-4


@dataclass(frozen=True, eq=False)
class DriftPaths:
    """Positions (n, steps, 3) in mm of both carriers at each step; NaN after collection."""

    electrons: FloatArray
    holes: FloatArray


@kernel
def drift(
    maps: DriftMaps,
    carrier: int,
    start: tuple[float, float, float],
    step_ns: float,
    stride: int,
    cloud: tuple[float, float, float],
    signal: FloatArray,
    path: FloatArray,
) -> tuple[int, bool, float, float, float]:
    r"""Drift one charge until it is collected, and add its induced signal to `signal`.

    With explicit Euler steps :math:`\mathbf{x}_{k+1} = \mathbf{x}_k + \mathbf{v}_k \Delta t`,
    a hole (+) or electron (-) induces (Shockley-Ramo)

    .. math:: S_k = \pm \sum_{j=1}^{k} e^{-(j - 1/2)\, \Delta t / \tau}
        \left[\phi_w(\mathbf{x}_j) - \phi_w(\mathbf{x}_{j-1})\right]

    with the weighting potential :math:`\phi_w` and the trapping time :math:`\tau`. Without
    trapping this is the change of the weighting potential since the start.

    Parameters
    ----------
    maps
        Field maps and velocities.
    carrier
        `ELECTRON` or `HOLE`.
    start
        Starting point x, y, z in mm.
    step_ns, stride
        Duration of one step in ns, and the number of short steps it replaces. The velocity
        is extrapolated linearly to the mean over these.
    cloud
        Initial FWHM in mm (0: a point), diffusion constant D/(v/E) and repulsion constant
        (see `cpunet.simulation.cloud`).
    signal
        Record with one value per step. The weighting potential gained (hole) or lost
        (electron) is added to it, up to the end of the record.
    path
        Array for the positions (steps, 3), or an empty array.

    Returns
    -------
    tuple
        Last step, whether the charge was collected, FWHM (mm) and speed (mm/ns) there, and
        the signal lost to trapping.
    """
    x, y, z = start
    ahead = (stride - 1) / (2 * stride)
    ux = uy = uz = 0.0
    sign = 1.0 if carrier == HOLE else -1.0
    size, diffusion, repulsion = cloud
    first = last = speed = induced = 0.0
    rate = maps.trapping_per_ns[carrier]
    # surviving charge, half a step earlier
    left, survival = math.exp(0.5 * rate * step_ns), math.exp(-rate * step_ns)
    n = len(signal)
    k, collected = 0, False
    while k < n:
        r = math.sqrt(x * x + y * y)  # math.hypot takes a sixth of the loop
        er, ez, wp, potential, usable = look_up(maps, r, z)
        if not usable:
            # beyond the surface of a contact: the remaining signal is induced in this step
            wp = 1.0 if last > 0.3 else 0.0
            collected = True
        if k == 0:
            first = wp
        if rate == 0.0:
            induced = sign * (wp - first)
        elif k > 0:
            left *= survival
            induced += sign * (wp - last) * left
        signal[k] += induced
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
        if stride > 1:
            wx, wy, wz = vx, vy, vz
            if k > 0:
                vx, vy, vz = (
                    vx + ahead * (vx - ux),
                    vy + ahead * (vy - uy),
                    vz + ahead * (vz - uz),
                )
            ux, uy, uz = wx, wy, wz
        # no charge leaves through the passivated face: it slides along the face
        x, y, z = x + vx * step_ns, y + vy * step_ns, max(z + vz * step_ns, 0.0)
        k += 1
    for later in range(k + 1, n):
        signal[later] += induced
    return k, collected, size, speed, sign * (last - first) - induced


def drift_paths(
    fields: Maps,
    x_mm: npt.ArrayLike,
    y_mm: npt.ArrayLike,
    z_mm: npt.ArrayLike,
    settings: SimulationSettings,
) -> DriftPaths:
    """Trajectories of both carriers from each starting point, one position per step.

    Parameters
    ----------
    fields
        Field maps of the detector.
    x_mm, y_mm, z_mm
        Starting points in mm.
    settings
        Simulation settings.

    Returns
    -------
    DriftPaths
        Positions (n, steps, 3) in mm of both carriers.
    """
    start = np.stack(np.broadcast_arrays(x_mm, y_mm, z_mm), axis=-1).astype(np.float64)
    start = start.reshape(-1, 3)
    maps = drift_maps(fields, settings)
    paths = np.full((2, len(start), settings.n_steps, 3), np.nan)
    _fill_paths(maps, start, settings.step_ns, paths)
    return DriftPaths(electrons=paths[ELECTRON], holes=paths[HOLE])


@kernel
def _fill_paths(maps: DriftMaps, start: FloatArray, step_ns: float, paths: FloatArray) -> None:
    signal = np.zeros(paths.shape[2])
    for i in range(len(start)):
        here = (start[i, 0], start[i, 1], start[i, 2])
        if in_active_volume(maps, here[0], here[1], here[2]):
            for carrier in range(2):
                drift(
                    maps, carrier, here, step_ns, 1, (0.0, 0.0, 0.0), signal, paths[carrier, i]
                )
