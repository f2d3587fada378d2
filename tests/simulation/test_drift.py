"""Drift velocities and trajectories: reference vectors and paths, and a planar detector."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpunet.simulation.drift_maps import ELECTRON, HOLE, V100, carrier_velocity, velocity_table
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator

STEPS = SimulationSettings(dt_ns=1, length_ns=3000)
component = st.floats(-4000, 4000, allow_nan=False)


def drift_paths(fields: FieldMaps, *places: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    return Simulator(read_detector("icpc"), STEPS, fields=fields).paths(*places)


def drift_velocity(
    table: tuple[np.ndarray, float], fields: npt.ArrayLike, carrier: int
) -> np.ndarray:
    """Velocity vectors (n, 3) for field vectors (n, 3)."""
    rows = np.asarray(fields, float).tolist()
    return np.array([carrier_velocity(*table, carrier, *row)[:3] for row in rows])


@pytest.mark.parametrize("far", [99.0, np.nan, np.inf, -np.inf, 1e300])
def test_nothing_drifts_from_a_contact_or_from_outside(planar: FieldMaps, far: float) -> None:
    paths = drift_paths(planar, [5.0, 5.0, far, 0.0], 0.0, [1.0, 13.0, 8.0, far])
    assert np.isnan(paths).all()
    _, holes = drift_paths(planar, 5.0, 3.0, 8.0)  # a single place is one path
    assert holes.shape == (1, STEPS.n_samples, 3)
    assert np.nanmin(holes[0, :, 2]) == pytest.approx(2, abs=0.1)


def test_reference_paths(reference_data: Path, reference_maps: FieldMaps) -> None:
    with np.load(reference_data / "siggen" / "drift_paths_A_grid0.1.npz") as data:
        start, expected = data["positions"], data["paths"][:, : STEPS.n_samples]
    electrons, holes = drift_paths(reference_maps, *start.T)
    # the reference holds electrons first; it drifted in maps five times finer than these
    holes = np.linalg.norm(holes - expected[..., 3:], axis=2)
    electrons = np.linalg.norm(electrons - expected[..., :3], axis=2)
    assert np.nanmax(holes) < 0.005
    assert np.median(np.nanmax(electrons, axis=1)) < 0.001
    assert np.nanmax(electrons) < 0.1


@pytest.mark.parametrize("temperature", [77, 90])
@pytest.mark.parametrize(("carrier", "name"), [(ELECTRON, "ve"), (HOLE, "vh")])
def test_reference_vectors(
    reference_data: Path, temperature: int, carrier: int, name: str
) -> None:
    with np.load(reference_data / "siggen" / "drift_velocity.npz") as data:
        field, expected = data["E"], data[f"{name}_{temperature}"]
    velocity = drift_velocity(velocity_table(temperature), field, carrier)
    np.testing.assert_allclose(velocity, expected, atol=3e-7)


@given(component, component, component)
def test_cubic_symmetry(x: float, y: float, z: float) -> None:
    table = velocity_table(90)
    for carrier in (ELECTRON, HOLE):
        vx, vy, vz = drift_velocity(table, [[x, y, z]], carrier)[0]
        turned = drift_velocity(table, [[-y, x, z], [y, z, x], [x, y, -z]], carrier)
        expected = [[-vy, vx, vz], [vy, vz, vx], [vx, vy, -vz]]
        np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_factors_hold_below_and_above_and_change_smoothly_in_between() -> None:
    factors = {"hole_velocity_low_factor": 0.9, "hole_velocity_high_factor": 1.2}
    own, scaled = velocity_table(90), velocity_table(90, STEPS.model_copy(update=factors))
    directions = np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1]]) / np.sqrt([[1], [2], [3]])
    for strength, factor in ((100.0, 0.9), (500.0, 1.05), (2000.0, 1.2)):
        for direction in directions:
            field = strength * direction[None]
            ratio = drift_velocity(scaled, field, HOLE) @ direction
            ratio = ratio / (drift_velocity(own, field, HOLE) @ direction)
            assert ratio == pytest.approx(factor, rel=1e-9)
            np.testing.assert_array_equal(
                drift_velocity(scaled, field, ELECTRON), drift_velocity(own, field, ELECTRON)
            )
    ratio = scaled[0][HOLE, 1:, V100] / own[0][HOLE, 1:, V100]  # at equidistant fields
    assert np.diff(ratio).min() >= -1e-12
    assert np.abs(np.diff(ratio)).max() < 0.1
