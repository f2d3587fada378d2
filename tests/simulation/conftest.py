"""Field maps for tests: a planar detector on paper, and the reference's."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

HEIGHT, BIAS = 10.0, 1000.0


@pytest.fixture(scope="session")
def planar() -> SimpleNamespace:
    """Contact at z = 2 mm (0 V), n+ at z = 12 mm (1000 V), 20 mm wide, uniform field."""
    grid = 0.5
    z = np.tile(np.arange(0, 14 + grid, grid), (round(20 / grid) + 1, 1))
    inside = (z >= 2) & (z <= 2 + HEIGHT)
    depth = np.clip((z - 2) / HEIGHT, 0, 1)
    return SimpleNamespace(
        grid_mm=grid,
        potential_V=BIAS * depth,
        e_r_V_per_cm=0 * z,
        e_z_V_per_cm=np.where(inside, -10 * BIAS / HEIGHT, 0.0),
        weighting_potential=1 - depth,
        region=np.where(inside, 2, 1).astype(np.int8),
    )


@pytest.fixture(scope="session")
def reference_maps(reference_data: Path) -> SimpleNamespace:
    """Siggen's maps of its 0.1 mm solution, every 0.5 mm."""
    names = {"potential_V": "V_01", "e_r_V_per_cm": "Er_01", "e_z_V_per_cm": "Ez_01"}
    names |= {"weighting_potential": "WP_01", "region": "point_type"}
    with np.load(reference_data / "siggen" / "maps_A_outertaper.npz") as maps:
        return SimpleNamespace(grid_mm=0.5, **{name: maps[key] for name, key in names.items()})
