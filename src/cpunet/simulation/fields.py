r"""Electric field and weighting potential of a detector, on uniform maps in r and z.

With space charge everywhere the potential is linear in its sources,

.. math:: V = b\, w + s\, u + t\, v + q,

with the bias :math:`b`, the scale :math:`s` and the tilt :math:`t` of the impurities. The parts
are :math:`w` (1 on the lithium contact), :math:`u` (impurities as given), :math:`v` (unit
tilt) and :math:`q` (surface charge). Bias, scale and tilt therefore need no new solution; the
parts are stored on disk, so that each detector is solved only once.

This is the true potential if it has no pocket in which holes would collect: no local minimum
except the electrodes. At such a minimum, or wherever the potential is below 0, germanium
is not depleted, and the potential is refused.
"""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import math
import os
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from scipy.ndimage import binary_erosion

from cpunet.errors import CpunetError
from cpunet.outputs import written_aside
from cpunet.progress import stage
from cpunet.pulses.reading.other_formats import read_arrays
from cpunet.simulation.geometry import Detector, FloatArray
from cpunet.simulation.outline import DITCH, GERMANIUM, LI_CONTACT
from cpunet.simulation.poisson import (
    HIGHEST_BIAS_V,
    Grid,
    Potentials,
    has_pocket,
    make_grid,
    on_nodes,
    solve_potentials,
)

log = logging.getLogger(__name__)

# part of the file name, so that results of an older solver are not used
SOLVER_VERSION = 5


# fields that do not affect the parts of the potential, and values in their place
_NOT_IN_PARTS = {
    "temperature_K": 90.0,
    "bias_V": 1.0,
    "impurity_scale": 1.0,
    "impurity_tilt_1e10_per_cm4": 0.0,
    "measured_depletion_V": 0.0,
}

_SCALE_RESOLUTION = 1e-5
_LARGEST_SCALE = 1000.0
# Maximum number of detector shapes (such as lithium thicknesses) whose potentials are held.
_MAX_SHAPES = 4


def solve(detector: Detector) -> Potentials:
    """Solve for the parts of a detector's potential, or load them.

    They are stored on disk (in ``$CPUNET_CACHE`` or the user's cache folder) and loaded if the
    same detector was solved before, at any bias and any scale and tilt of its impurities. The
    last few are held in memory.

    Raises
    ------
    CpunetError
        If the grid is too fine.
    """
    folder = os.environ.get("CPUNET_CACHE") or platformdirs.user_cache_dir("cpunet")
    values = detector.model_dump(mode="json", exclude={"name", *_NOT_IN_PARTS})
    key = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:24]
    file = Path(folder) / "fields" / f"{key}-{SOLVER_VERSION}.npz"
    return solved(detector.model_copy(update=_NOT_IN_PARTS), file)


@functools.lru_cache(_MAX_SHAPES)
def solved(unit: Detector, file: Path) -> Potentials:
    """Parts of the potential of a detector with unit impurities, see `solve`."""
    with suppress(CpunetError, LookupError):  # if damaged, solved again and overwritten
        arrays: dict[str, Any] = read_arrays(file)
        stored = {field.name: arrays[field.name] for field in fields(Potentials)}
        return Potentials(**{k: v if v.ndim else v.item() for k, v in stored.items()})
    with stage(f"Fields of {unit.name or 'the detector'}"):
        grid = make_grid(unit)
        log.debug(f"potentials on {len(grid.r_mm)} x {len(grid.z_mm)} nodes")
        potentials = solve_potentials(unit, grid)
    # atomically; a cache that cannot be written is ignored
    with suppress(CpunetError), written_aside(file) as aside:
        np.savez(aside, allow_pickle=False, **vars(potentials))
    return potentials


_V_PER_CM = 10.0  # of 1 V / mm


@dataclass(frozen=True, eq=False)
class FieldMaps(Potentials):
    """Fields at the nodes of the parts of the potential, for a bias and impurities.

    Maps have shape (nr, nz). The field is E = -grad V in V/cm. It is 0 in contacts and
    outside; on the walls of the ditch it is that of the germanium. `impurity` is the scale and
    the tilt of the impurities.
    """

    potential_V: FloatArray
    e_r_V_per_cm: FloatArray
    e_z_V_per_cm: FloatArray
    impurity: tuple[float, float]

    @functools.cached_property
    def depletion_V(self) -> float:
        """Smallest bias in V that depletes the detector.

        With tilted impurities or a surface charge this takes longer than all maps.
        """
        return self.depletion(*self.impurity)


def compute_fields(detector: Detector) -> FieldMaps:
    """Superpose the fields of a fully depleted detector from the parts that `solve` gives.

    Raises
    ------
    CpunetError
        If the detector is not fully depleted, or the grid is too fine.
    """
    parts, bias = solve(detector), detector.bias_V
    impurity = detector.impurity_scale, detector.impurity_tilt_1e10_per_cm4
    volts = parts.total_V(bias, *impurity)
    if has_pocket(volts, parts.region):
        if (needed := parts.depletion(*impurity)) == math.inf:
            raise CpunetError(
                f"detector {detector.name}: no bias up to {HIGHEST_BIAS_V:.0f} V depletes it; "
                "check impurity_z0_1e10_per_cm3 and impurity_gradient_1e10_per_cm4"
            )
        raise CpunetError(
            f"detector {detector.name}: bias_V = {bias:g} does not deplete it; "
            f"give at least the depletion voltage, {np.ceil(needed):.0f} V"
        )
    # without a charge or a plane below it, the field has no component normal to the face z = 0
    mirror = not (detector.vacuum_gap or detector.surface_charge_1e10_per_cm2)
    e_r, e_z = electric_field(volts, parts, mirror=mirror)
    return FieldMaps(
        **vars(parts), potential_V=volts, e_r_V_per_cm=e_r, e_z_V_per_cm=e_z, impurity=impurity
    )


def scaled_to_depletion(detector: Detector) -> Detector:
    """Detector with its impurities scaled so that it depletes at the measured voltage.

    Manufacturers measure impurity densities to about 10 %, while the depletion voltage is
    measured to a few volts.

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
    parts, tilt = solve(detector), detector.impurity_tilt_1e10_per_cm4
    low, high = 1 / _LARGEST_SCALE, _LARGEST_SCALE
    while high / low > 1 + _SCALE_RESOLUTION:
        middle = math.sqrt(low * high)
        pocket = has_pocket(parts.total_V(measured, middle, tilt), parts.region)
        low, high = (low, middle) if pocket else (middle, high)
    if low == 1 / _LARGEST_SCALE or high == _LARGEST_SCALE:
        raise CpunetError(
            f"detector {detector.name}: between {1 / _LARGEST_SCALE:g} and {_LARGEST_SCALE:g} "
            f"times its impurities none depletes at {measured:g} V; correct "
            "measured_depletion_V, impurity_z0_1e10_per_cm3 or surface_charge_1e10_per_cm2"
        )
    voltage = f"the measured {measured:g} V"
    log.info(f"{detector.name}: impurities times {low:.4g}, so that it depletes at {voltage}")
    return detector.model_copy(update={"impurity_scale": low})


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

    >>> nodes = Grid(r_mm=np.arange(3.0), z_mm=np.arange(4.0), grid_mm=1.0,
    ...     region=np.full((3, 4), 2, np.int8), r_steps=np.ones((2, 4)),
    ...     z_steps=np.ones((3, 3)))
    >>> e_r, e_z = electric_field(np.tile(100 * nodes.z_mm, (3, 1)), nodes, mirror=False)
    >>> bool((e_r == 0).all()), e_z[1].tolist()
    (True, [-1000.0, -1000.0, -1000.0, -1000.0])
    """
    components = []
    along_r = potential, grid.r_steps, grid.region
    along_z = potential.T, grid.z_steps.T, grid.region.T
    for volts, steps, region in (along_r, along_z):
        # the parabola through a node and its neighbours; across a wall of the ditch the slope
        # jumps: only the germanium side counts
        ditch = region == DITCH
        rise = np.diff(volts, axis=0) / (steps * grid.grid_mm)
        weight = np.where(ditch[:-1] & ditch[1:], 1e-9, 1.0) / (steps * grid.grid_mm)
        slope = on_nodes(weight * rise, weight * rise, axis=0)
        slope /= on_nodes(weight, weight, axis=0)
        components.append(-_V_PER_CM * slope)
    e_r, e_z = components[0], components[1].T
    e_r[0] = 0
    if mirror:
        e_z[:, 0] = 0
    contact = grid.region <= LI_CONTACT
    e_r[contact] = e_z[contact] = 0
    return e_r, e_z


def fields_in_words(detector: Detector, fields: FieldMaps) -> list[tuple[str, str]]:
    """Names and texts: capacitance, depletion voltage, bias, extremes of the bulk's field."""
    strength = np.hypot(fields.e_r_V_per_cm, fields.e_z_V_per_cm)
    # next to contacts and the ditch the field is only a one-sided difference
    germanium = fields.region == GERMANIUM
    bulk = binary_erosion(germanium, border_value=1)
    bulk[:, 0] = germanium[:, 0]
    measured, scale = detector.measured_depletion_V, detector.impurity_scale
    lines = [
        ("detector", detector.name),
        ("capacitance", f"{fields.capacitance_pF:.3f} pF"),
        ("depletion voltage", f"{fields.depletion_V:.0f} V"),
        ("measured depletion", f"{measured:g} V" if measured else ""),
        ("impurity_scale", f"{scale:.6g}" if scale != 1 else ""),
        ("bias", f"{detector.bias_V:g} V"),
    ]
    lowest = np.where(bulk, strength, np.inf).argmin()
    highest = np.where(bulk, strength, -np.inf).argmax()
    for name, node in (("lowest field", lowest), ("highest field", highest)):
        i, j = np.unravel_index(node, strength.shape)
        place = f"r {fields.r_mm[i]:.1f}, z {fields.z_mm[j]:.1f} mm"
        lines.append((name, f"{strength[i, j]:.0f} V/cm at {place}"))
    return [(name, text) for name, text in lines if text]
