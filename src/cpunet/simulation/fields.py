"""Electric field and weighting potential of a detector, on uniform maps in r and z."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cpunet.errors import CpunetError
from cpunet.simulation.geometry import DITCH, LI_CONTACT, Detector, FloatArray, RegionArray
from cpunet.simulation.poisson import CONTACT_EDGE, DITCH_EDGE, Grid, point_types
from cpunet.simulation.superposition import Superposition, solve

log = logging.getLogger(__name__)

_V_PER_CM = 10.0  # of 1 V / mm


@dataclass(frozen=True, eq=False)
class FieldMaps:
    """Fields at the nodes ``r_mm`` (nr) times ``z_mm`` (nz), spaced by `grid_mm`.

    Maps have shape (nr, nz). The field is E = -grad V in V/cm. It is 0 in contacts and
    outside; on the walls of the ditch it is that of the germanium. `point_type` is 0 in the
    point contact, 1 in the lithium contact and outside, 2 in germanium, 3 in germanium on the
    passivated face z = 0, 5 in the ditch, 6 and 7 in germanium next to the ditch and next to
    a contact.
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


def compute_fields(detector: Detector, *, cache: bool = True) -> FieldMaps:
    """Solve for the fields of a fully depleted detector, or load them from the cache.

    Parameters
    ----------
    detector
        Geometry, impurities and bias.
    cache
        See `cpunet.simulation.superposition.solve`.

    Raises
    ------
    CpunetError
        If the detector is not fully depleted, or the grid is too fine.
    """
    return superposed_fields(solve(detector, cache=cache), detector)


def superposed_fields(
    solution: Superposition, detector: Detector, *, depletion: bool = True
) -> FieldMaps:
    """Fields of a detector from a solution for any bias, scale and tilt of its impurities.

    Parameters
    ----------
    solution
        Solution of the detector.
    detector
        Detector with the bias, the temperature and the impurities wanted.
    depletion
        Whether to determine ``depletion_V``; NaN otherwise. With tilted impurities or a
        surface charge this takes longer than everything else.

    Raises
    ------
    CpunetError
        If the detector is not fully depleted.
    """
    grid, parts = solution.grid, solution.potentials
    impurities = detector.impurity_scale, detector.impurity_tilt_1e10_per_cm4
    potential = solution.potential_V(detector.bias_V, *impurities)
    # without a charge or a plane there, the field has no component normal to the face z = 0
    mirror = not (detector.vacuum_gap or detector.surface_charge_1e10_per_cm2)
    e_r, e_z = electric_field(potential, grid, mirror=mirror)
    return FieldMaps(
        r_mm=grid.r_mm,
        z_mm=grid.z_mm,
        grid_mm=grid.step_mm,
        potential_V=potential,
        e_r_V_per_cm=e_r,
        e_z_V_per_cm=e_z,
        weighting_potential=parts.point_contact,
        point_type=point_types(grid),
        temperature_K=detector.temperature_K,
        capacitance_pF=parts.capacitance_pF,
        depletion_V=solution.depletion_V(*impurities) if depletion else np.nan,
    )


def scaled_to_depletion(detector: Detector) -> Detector:
    """Detector with its impurities scaled so that it depletes at the measured voltage.

    Manufacturers measure impurity densities to about 10 %, while the depletion voltage is
    known to a few volts.

    Raises
    ------
    CpunetError
        If the detector has no ``measured_depletion_V``, or no scale leads to it.
    """
    measured = detector.measured_depletion_V
    if not measured:
        raise CpunetError(
            f"detector {detector.name}: no measured_depletion_V to scale its impurities by; "
            "add it to the file, or give `settings` measured_depletion_V=VALUE"
        )
    solution = solve(detector)
    scale = solution.scale_of_depletion(measured, detector.impurity_tilt_1e10_per_cm4)
    log.info(
        f"{detector.name}: impurities times {scale:.4g}, so that it depletes at the measured "
        f"{measured:g} V"
    )
    return detector.model_copy(update={"impurity_scale": scale})


def electric_field(
    potential: FloatArray, grid: Grid, *, mirror: bool
) -> tuple[FloatArray, FloatArray]:
    r"""Electric field :math:`\mathbf{E} = -\nabla V` in V/cm.

    Central differences are used, with the true distances next to contacts.

    Parameters
    ----------
    potential
        Potential in V, shape (nr, nz).
    grid
        Nodes of the potential.
    mirror
        Whether z = 0 is a mirror plane, as the axis always is.

    Returns
    -------
    e_r, e_z
        Field components, shape (nr, nz) each; 0 in contacts.

    Examples
    --------
    A potential of 100 V/mm along z is a field of -1000 V/cm.

    >>> nodes = Grid(r_mm=np.arange(3.0), z_mm=np.arange(4.0), step_mm=1.0,
    ...     region=np.full((3, 4), 2, np.int8), r_steps=np.ones((2, 4)),
    ...     z_steps=np.ones((3, 3)))
    >>> e_r, e_z = electric_field(np.tile(100 * nodes.z_mm, (3, 1)), nodes, mirror=False)
    >>> bool((e_r == 0).all()), e_z[1].tolist()
    (True, [-1000.0, -1000.0, -1000.0, -1000.0])
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
    """Derivative along the first axis of the parabola through a node and its neighbours."""
    # across a wall of the ditch the slope jumps: only the germanium side counts there
    ditch = region == DITCH
    vacuum = ditch[:-1] & ditch[1:]
    rise = np.diff(potential, axis=0) / steps
    weight = np.where(vacuum, 1e-9, 1.0) / steps
    slope, total = np.zeros_like(potential), np.zeros_like(potential)
    for nodes in (slice(None, -1), slice(1, None)):
        slope[nodes] += weight * rise
        total[nodes] += weight
    return slope / total


def fields_in_words(detector: Detector, fields: FieldMaps) -> list[tuple[str, str]]:
    """Names and texts: capacitance, depletion voltage, bias, extremes of the bulk's field."""
    strength = np.hypot(fields.e_r_V_per_cm, fields.e_z_V_per_cm)
    # next to contacts and the ditch the field is only a one-sided difference
    bulk = fields.point_type > LI_CONTACT
    bulk &= fields.point_type < DITCH_EDGE
    bulk &= fields.point_type != CONTACT_EDGE
    bulk &= detector.active(fields.r_mm[:, None], fields.z_mm[None, :])
    measured, scale = detector.measured_depletion_V, detector.impurity_scale
    lines = [
        ("detector", detector.name),
        ("capacitance", f"{fields.capacitance_pF:.3f} pF"),
        ("depletion voltage", f"{fields.depletion_V:.0f} V"),
        ("measured depletion", f"{measured:g} V" if measured else ""),
        ("impurity_scale", f"{scale:.6g}" if scale != 1 else ""),
        ("bias", f"{detector.bias_V:g} V"),
        ("lowest field", _at(fields, np.where(bulk, strength, np.inf), np.argmin)),
        ("highest field", _at(fields, np.where(bulk, strength, -np.inf), np.argmax)),
    ]
    return [(name, text) for name, text in lines if text]


def _at(
    fields: FieldMaps, strength: FloatArray, extreme: Callable[[FloatArray], np.intp]
) -> str:
    i, j = np.unravel_index(extreme(strength), strength.shape)
    place = f"r {fields.r_mm[i]:.1f}, z {fields.z_mm[j]:.1f} mm"
    return f"{strength[i, j]:.0f} V/cm at {place}"
