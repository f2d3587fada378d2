"""Trajectories: a planar detector on paper, and reference paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cpunet.simulation.drift import drift_paths
from cpunet.simulation.field_lookup import Maps
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.velocity import HOLE, drift_velocity, velocity_table

STEPS = SimulationSettings(dt_ns=1, library_step_ns=1, length_ns=3000)


def test_uniform_field_moves_charges_at_constant_speed(planar: Maps) -> None:
    paths = drift_paths(planar, [5.0], [3.0], [8.0], STEPS)
    speed = -drift_velocity(velocity_table(90), [[0, 0, -1000.0]], HOLE)[0, 2]
    hole = paths.holes[0]
    n = np.isfinite(hole[:, 2]).sum()
    assert n == pytest.approx(6 / speed, abs=2)
    np.testing.assert_allclose(hole[: n - 1, 2], 8 - speed * np.arange(n - 1), atol=1e-4)
    np.testing.assert_allclose(hole[: n - 1, :2], [[5, 3]] * (n - 1), atol=1e-12)
    assert np.nanmax(paths.electrons[0, :, 2]) == pytest.approx(12, abs=0.15)


def test_nothing_drifts_from_a_contact_or_from_outside(planar: Maps) -> None:
    paths = drift_paths(planar, [5.0, 5.0, 99.0], 0.0, [1.0, 13.0, 8.0], STEPS)
    assert np.isnan(paths.holes).all()
    assert np.isnan(paths.electrons).all()


@pytest.mark.parametrize("far", [np.nan, np.inf, -np.inf, 1e300])
def test_nothing_drifts_from_where_nothing_can_be(planar: Maps, far: float) -> None:
    paths = drift_paths(planar, [far, 0.0], 0.0, [8.0, far], STEPS)
    assert np.isnan(paths.holes).all()


def test_a_single_place_is_one_path(planar: Maps) -> None:
    paths = drift_paths(planar, 5.0, 3.0, 8.0, STEPS)
    assert paths.holes.shape == (1, STEPS.n_steps, 3)
    np.testing.assert_array_equal(paths.holes, drift_paths(planar, [5], [3], [8], STEPS).holes)


def test_reference_paths(reference_data: Path, reference_maps: Maps) -> None:
    with np.load(reference_data / "siggen" / "drift_paths_A_grid0.1.npz") as data:
        start, expected = data["positions"], data["paths"][:, : STEPS.n_steps]
    paths = drift_paths(reference_maps, *start.T, STEPS)
    # the reference holds electrons first; it drifted in maps five times finer than these
    holes = np.linalg.norm(paths.holes - expected[..., 3:], axis=2)
    electrons = np.linalg.norm(paths.electrons - expected[..., :3], axis=2)
    assert np.nanmax(holes) < 0.005
    assert np.median(np.nanmax(electrons, axis=1)) < 0.001
    assert np.nanmax(electrons) < 0.1
