"""Trajectories: a planar detector on paper, and reference paths."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from cpunet.simulation.drift import drift_paths
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.velocity import HOLE, drift_velocity, velocity_table

Array = npt.NDArray[np.float64]
HEIGHT, BIAS = 10.0, 1000.0


@dataclass(frozen=True, eq=False)
class ToyMaps:
    grid_mm: float
    potential_V: Array
    e_r_V_per_cm: Array
    e_z_V_per_cm: Array
    weighting_potential: Array
    point_type: npt.NDArray[np.int8]
    temperature_K: float = 90.0


def planar(grid: float = 0.5) -> ToyMaps:
    """Contact at z = 2 mm (0 V), n+ at z = 12 mm (1000 V), 20 mm wide, uniform field."""
    _, z = np.meshgrid(
        np.arange(0, 20 + grid, grid), np.arange(0, 14 + grid, grid), indexing="ij"
    )
    depth = np.clip((z - 2) / HEIGHT, 0, 1)
    inside = (z >= 2) & (z <= 2 + HEIGHT)
    field = np.where(inside, -10 * BIAS / HEIGHT, 0.0)
    kinds = np.where(inside, 2, 1).astype(np.int8)
    return ToyMaps(grid, BIAS * depth, 0 * field, field, 1 - depth, kinds)


def reference_maps(folder: Path) -> ToyMaps:
    with np.load(folder / "siggen" / "maps_A_outertaper.npz") as maps:
        return ToyMaps(
            0.5, maps["V_01"], maps["Er_01"], maps["Ez_01"], maps["WP_01"], maps["point_type"]
        )


STEPS = SimulationSettings(dt_ns=1, library_step_ns=1, length_ns=3000)


def test_uniform_field_moves_charges_at_constant_speed() -> None:
    paths = drift_paths(planar(), [5.0], [3.0], [8.0], STEPS)
    speed = -drift_velocity(velocity_table(90), [[0, 0, -1000.0]], HOLE)[0, 2]
    hole = paths.holes[0]
    n = np.isfinite(hole[:, 2]).sum()
    assert n == pytest.approx(6 / speed, abs=2)
    np.testing.assert_allclose(hole[: n - 1, 2], 8 - speed * np.arange(n - 1), atol=1e-9)
    np.testing.assert_allclose(hole[: n - 1, :2], [[5, 3]] * (n - 1), atol=1e-12)
    assert np.nanmax(paths.electrons[0, :, 2]) == pytest.approx(12, abs=0.15)


def test_nothing_drifts_from_a_contact_or_from_outside() -> None:
    paths = drift_paths(planar(), [5.0, 5.0, 99.0], 0.0, [1.0, 13.0, 8.0], STEPS)
    assert np.isnan(paths.holes).all()
    assert np.isnan(paths.electrons).all()


def test_reference_paths(reference_data: Path) -> None:
    with np.load(reference_data / "siggen" / "drift_paths_A_grid0.1.npz") as data:
        start, expected = data["positions"], data["paths"][:, : STEPS.n_steps]
    paths = drift_paths(reference_maps(reference_data), *start.T, STEPS)
    # the reference holds electrons first; its maps were five times finer than these
    holes = np.linalg.norm(paths.holes - expected[..., 3:], axis=2)
    electrons = np.linalg.norm(paths.electrons - expected[..., :3], axis=2)
    assert np.nanmax(holes) < 0.05
    assert np.median(np.nanmax(electrons, axis=1)) < 0.005
    assert np.nanmax(electrons) < 0.3
