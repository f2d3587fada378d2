"""Electric field and weighting potential of a detector, on uniform maps in r and z."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.simulation import field_cache
from cpunet.simulation.depletion import HIGHEST_BIAS_V, depletion_voltage
from cpunet.simulation.geometry import DITCH, LI_CONTACT, Detector, FloatArray, RegionArray
from cpunet.simulation.grid import Grid, make_grid, point_types
from cpunet.simulation.poisson import solve_potentials

Progress = Callable[[str], None]

_V_PER_CM = 10.0  # of 1 V / mm
# neither matters to the fields
_NOT_IN_FIELDS = ("name", "temperature_K")


@dataclass(frozen=True, eq=False)
class FieldMaps:
    """Fields at the nodes ``r_mm`` (nr) times ``z_mm`` (nz), `grid_mm` apart.

    Maps have shape (nr, nz).  The field is E = -grad V, in V/cm, and 0 in contacts and
    outside; on walls of the ditch it is that of the germanium.  `point_type` is 0 in the
    point contact, 1 in the lithium contact and outside, 2 in germanium, 3 there on the
    passivated face z = 0, 5 in the ditch, 6 and 7 in germanium beside the ditch and
    beside a contact.
    """

    r_mm: FloatArray
    z_mm: FloatArray
    grid_mm: float
    potential_V: FloatArray
    e_r_V_per_cm: FloatArray
    e_z_V_per_cm: FloatArray
    weighting_potential: FloatArray
    point_type: RegionArray
    temperature_K: float
    capacitance_pF: float
    depletion_V: float


def compute_fields(
    detector: Detector, *, cache: bool = True, progress: Progress | None = None
) -> FieldMaps:
    """Solve for the fields of a fully depleted detector, or take them from the cache.

    Parameters
    ----------
    detector
        Geometry, impurities and bias.
    cache
        Keep the maps on disk (in ``$CPUNET_CACHE``, or the user's cache folder) and
        take them from there if the same detector was solved before.
    progress
        Called with a few words as each part starts.

    Raises
    ------
    CpunetError
        If the detector is not fully depleted, or the grid is too fine.
    """
    key = detector.fingerprint(exclude=_NOT_IN_FIELDS)
    if cache and (kept := field_cache.load(key)) is not None:
        return FieldMaps(**kept, temperature_K=detector.temperature_K)
    say = progress or (lambda _: None)
    grid = make_grid(detector)
    say(f"potentials on {len(grid.r_mm)} x {len(grid.z_mm)} nodes")
    potentials = solve_potentials(detector, grid)
    say("depletion voltage")
    depletion = depletion_voltage(potentials.bias, potentials.impurities, grid.region)
    _refuse_undepleted(detector, depletion)
    potential = detector.bias_V * potentials.bias + potentials.impurities
    e_r, e_z = electric_field(potential, grid, mirror=not _charged_face(detector))
    maps: dict[str, Any] = {
        "r_mm": grid.r_mm,
        "z_mm": grid.z_mm,
        "grid_mm": detector.grid_mm,
        "potential_V": potential,
        "e_r_V_per_cm": e_r,
        "e_z_V_per_cm": e_z,
        "weighting_potential": potentials.point_contact,
        "point_type": point_types(grid),
        "capacitance_pF": potentials.capacitance_pF,
        "depletion_V": depletion,
    }
    if cache:
        field_cache.store(key, maps)
    return FieldMaps(**maps, temperature_K=detector.temperature_K)


def _refuse_undepleted(detector: Detector, depletion_V: float) -> None:
    if depletion_V == float("inf"):
        raise CpunetError(
            f"detector {detector.name}: no bias up to {HIGHEST_BIAS_V:.0f} V depletes it; "
            "check impurity_z0_1e10_per_cm3 and impurity_gradient_1e10_per_cm4"
        )
    if detector.bias_V < depletion_V:
        raise CpunetError(
            f"detector {detector.name}: bias_V = {detector.bias_V:g} does not deplete it; "
            f"give at least the depletion voltage, {np.ceil(depletion_V):.0f} V"
        )


def _charged_face(detector: Detector) -> bool:
    """Whether the field on z = 0 has a component across it."""
    return bool(detector.vacuum_gap or detector.surface_charge_1e10_per_cm2)


def electric_field(
    potential: FloatArray, grid: Grid, *, mirror: bool
) -> tuple[FloatArray, FloatArray]:
    """E = -grad V in V/cm: central differences, with true distances beside contacts.

    Parameters
    ----------
    potential
        In V, (nr, nz).
    grid
        The nodes it is given on.
    mirror
        Whether z = 0 is a mirror, as the axis always is.

    Returns
    -------
    e_r, e_z
        (nr, nz) each; 0 in contacts.
    """
    e_r = -_V_PER_CM * _slope(potential, grid.r_steps * grid.step_mm, grid.region)
    e_z = -_V_PER_CM * _slope(potential.T, grid.z_steps.T * grid.step_mm, grid.region.T).T
    e_r[0] = 0
    if mirror:
        e_z[:, 0] = 0
    contact = grid.region <= LI_CONTACT
    e_r[contact] = e_z[contact] = 0
    return e_r, e_z


def _slope(potential: FloatArray, steps: FloatArray, region: RegionArray) -> FloatArray:
    """Derivative along the first axis of a node's parabola through its two neighbours."""
    # across a wall of the ditch the slope jumps: only the germanium's side counts there
    ditch = region == DITCH
    vacuum = ditch[:-1] & ditch[1:]
    rise = np.diff(potential, axis=0) / steps
    weight = np.where(vacuum, 1e-9, 1.0) / steps
    slope, total = np.zeros_like(potential), np.zeros_like(potential)
    for nodes in (slice(None, -1), slice(1, None)):
        slope[nodes] += weight * rise
        total[nodes] += weight
    return slope / total
