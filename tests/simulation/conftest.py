"""Field maps for tests: a planar detector on paper, and the reference's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

Array = npt.NDArray[np.float64]
HEIGHT, BIAS = 10.0, 1000.0


@dataclass(frozen=True, eq=False)
class ToyMaps:
    grid_mm: float
    potential_V: Array
    e_r_V_per_cm: Array
    e_z_V_per_cm: Array
    weighting_potential: Array
    region: npt.NDArray[np.int8]


@pytest.fixture(scope="session")
def planar() -> ToyMaps:
    """Contact at z = 2 mm (0 V), n+ at z = 12 mm (1000 V), 20 mm wide, uniform field."""
    grid = 0.5
    _, z = np.meshgrid(
        np.arange(0, 20 + grid, grid), np.arange(0, 14 + grid, grid), indexing="ij"
    )
    depth = np.clip((z - 2) / HEIGHT, 0, 1)
    inside = (z >= 2) & (z <= 2 + HEIGHT)
    field = np.where(inside, -10 * BIAS / HEIGHT, 0.0)
    kinds = np.where(inside, 2, 1).astype(np.int8)
    return ToyMaps(grid, BIAS * depth, 0 * field, field, 1 - depth, kinds)


@pytest.fixture(scope="session")
def reference_maps(reference_data: Path) -> ToyMaps:
    """Siggen's maps of its 0.1 mm solution, every 0.5 mm."""
    with np.load(reference_data / "siggen" / "maps_A_outertaper.npz") as maps:
        return ToyMaps(
            0.5, maps["V_01"], maps["Er_01"], maps["Ez_01"], maps["WP_01"], maps["point_type"]
        )
