r"""One solution of a detector for every bias and every scale of its impurities.

With space charge everywhere the potential is linear in its sources,

.. math:: V = b\, w + s\, u + t\, v + q,

with the bias :math:`b`, the scale :math:`s` and the tilt :math:`t` of the impurities. The parts
are :math:`w` (1 on the lithium contact), :math:`u` (impurities as given), :math:`v` (unit
tilt) and :math:`q` (surface charge). Bias, scale and tilt therefore need no new solution. This
does not hold if part of the detector is not depleted. Such a potential has a pocket (see
`cpunet.simulation.depletion`) and is refused.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from cpunet.errors import CpunetError
from cpunet.simulation import field_cache
from cpunet.simulation.depletion import HIGHEST_BIAS_V, depletion_voltage, has_pocket
from cpunet.simulation.geometry import Detector, FloatArray
from cpunet.simulation.grid import Grid, make_grid
from cpunet.simulation.poisson import Potentials, solve_potentials

log = logging.getLogger(__name__)

# fields that do not affect the parts of the potential
NOT_IN_PARTS = (
    "name",
    "temperature_K",
    "bias_V",
    "impurity_scale",
    "impurity_tilt_1e10_per_cm4",
    "measured_depletion_V",
)

_SCALE_RESOLUTION = 1e-5
_LARGEST_SCALE = 1000.0


@dataclass(frozen=True, eq=False)
class Superposition:
    """Contributions of the bias, the impurities and a surface charge to the potential.

    Parameters
    ----------
    detector
        Detector as solved. Its bias is irrelevant, and its impurities are neither scaled nor
        tilted.
    grid, potentials
        Nodes, and the parts of the potential at them.
    unit_depletion_V
        Depletion voltage in V for an ``impurity_scale`` of 1; infinite above 20 kV.
    """

    detector: Detector
    grid: Grid
    potentials: Potentials
    unit_depletion_V: float

    def potential_V(
        self, bias_V: float, impurity_scale: float = 1.0, impurity_tilt: float = 0.0
    ) -> FloatArray:
        r"""Potential (nr, nz) in V for a bias in V and scaled and tilted impurities.

        .. math:: V = b\, w + s\, u + t\, v + q

        The tilt is in 1e10/cm4.

        Raises
        ------
        CpunetError
            If the detector is not depleted, so that the superposition does not hold.
        """
        potential = self._sum(bias_V, impurity_scale, impurity_tilt)
        if has_pocket(potential, self.grid.region):
            self._refuse(bias_V, impurity_scale, impurity_tilt)
        return potential

    def depletion_V(self, impurity_scale: float = 1.0, impurity_tilt: float = 0.0) -> float:
        """Smallest bias in V that depletes the detector; infinite if none up to 20 kV does."""
        alone = not self.detector.surface_charge_1e10_per_cm2 and impurity_tilt == 0
        if alone and math.isfinite(self.unit_depletion_V):
            # without another charge, all of V scales together
            depletion = impurity_scale * self.unit_depletion_V
            return depletion if depletion <= HIGHEST_BIAS_V else math.inf
        return depletion_voltage(
            self.potentials.bias,
            self._sum(0.0, impurity_scale, impurity_tilt),
            self.grid.region,
        )

    def scale_of_depletion(self, depletion_V: float, impurity_tilt: float = 0.0) -> float:
        """Scale of the impurities at which the detector just depletes at `depletion_V`.

        Raises
        ------
        CpunetError
            If there is no such scale.
        """
        low, high = 1 / _LARGEST_SCALE, _LARGEST_SCALE
        what = f"detector {self.detector.name}: {depletion_V:g} V"
        if self._pocket(depletion_V, low, impurity_tilt):
            raise CpunetError(
                f"{what} do not deplete it even with {low:g} of its impurities; correct "
                "measured_depletion_V, impurity_z0_1e10_per_cm3 or surface_charge_1e10_per_cm2"
            )
        if not self._pocket(depletion_V, high, impurity_tilt):
            raise CpunetError(
                f"{what} deplete it even with {high:g} times its impurities; correct "
                "measured_depletion_V or impurity_z0_1e10_per_cm3"
            )
        while high / low > 1 + _SCALE_RESOLUTION:
            middle = math.sqrt(low * high)
            if self._pocket(depletion_V, middle, impurity_tilt):
                high = middle
            else:
                low = middle
        return low

    def _sum(self, bias_V: float, impurity_scale: float, impurity_tilt: float) -> FloatArray:
        parts = self.potentials
        total = bias_V * parts.bias + impurity_scale * parts.impurities + parts.surface
        return total + impurity_tilt * parts.tilt if impurity_tilt else total

    def _pocket(self, bias_V: float, impurity_scale: float, impurity_tilt: float) -> bool:
        return has_pocket(self._sum(bias_V, impurity_scale, impurity_tilt), self.grid.region)

    def _refuse(self, bias_V: float, impurity_scale: float, impurity_tilt: float) -> None:
        depletion = self.depletion_V(impurity_scale, impurity_tilt)
        name = self.detector.name
        if depletion == math.inf:
            raise CpunetError(
                f"detector {name}: no bias up to {HIGHEST_BIAS_V:.0f} V depletes it; "
                "check impurity_z0_1e10_per_cm3 and impurity_gradient_1e10_per_cm4"
            )
        raise CpunetError(
            f"detector {name}: bias_V = {bias_V:g} does not deplete it; "
            f"give at least the depletion voltage, {np.ceil(depletion):.0f} V"
        )


def solve(detector: Detector, *, cache: bool = True) -> Superposition:
    """Solve for the parts of a detector's potential, or load them from the cache.

    Parameters
    ----------
    detector
        Geometry and impurities.
    cache
        Whether to keep the parts on disk (in ``$CPUNET_CACHE`` or the user's cache folder)
        and to load them if the same detector was solved before, at any bias and any scale and
        tilt of its impurities.

    Raises
    ------
    CpunetError
        If the grid is too fine.
    """
    key = detector.fingerprint(exclude=NOT_IN_PARTS)
    unit = detector.model_copy(
        update={"impurity_scale": 1.0, "impurity_tilt_1e10_per_cm4": 0.0}
    )
    if cache and (kept := field_cache.load(key, detector.grid_mm)) is not None:
        return Superposition(unit, *kept)
    grid = make_grid(unit)
    log.debug(f"potentials on {len(grid.r_mm)} x {len(grid.z_mm)} nodes")
    potentials = solve_potentials(unit, grid)
    log.debug("depletion voltage")
    fixed = potentials.impurities + potentials.surface
    depletion = depletion_voltage(potentials.bias, fixed, grid.region)
    if cache:
        field_cache.store(key, grid, potentials, depletion)
    return Superposition(unit, grid, potentials, depletion)
