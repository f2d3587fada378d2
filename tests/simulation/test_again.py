"""The same hits with other physics."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import gaussian_filter1d

from cpunet.simulation import simulate
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulate import SameHits
from cpunet.simulation.simulator import EventPulses, Simulator

DETECTOR = read_detector("ppc", ["grid_mm=0.5"])
SHORT = SimulationSettings(length_ns=1600)


@pytest.fixture(scope="module")
def hits() -> Hits:
    """Events of three hits, one of them often in the lithium layer."""
    rng = np.random.default_rng(1)
    size = DETECTOR.crystal_radius / 1.4
    place = rng.uniform([-size, -size, 0], [size, size, DETECTOR.crystal_length], (120, 3))
    return Hits.of(place, rng.uniform(50, 1000, 120), np.arange(0, 121, 3))


def changed(**values: Any) -> tuple[Detector, SimulationSettings]:
    of_detector = {k: v for k, v in values.items() if k in Detector.model_fields}
    of_settings = {k: v for k, v in values.items() if k not in of_detector}
    detector = DETECTOR.model_copy(update=of_detector)
    return detector, SHORT.model_copy(update=of_settings)


@pytest.mark.usefixtures("own_cache")
def test_it_is_a_new_simulation_from_one_solution(
    hits: Hits, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved: list[Detector] = []
    solve = simulate.solve
    monkeypatch.setattr(simulate, "solve", lambda d: solved.append(d) or solve(d))
    same = SameHits(hits)
    first = same.simulate(DETECTOR, SHORT)
    of_detector = {"temperature_K": 95.0, "bias_V": 2600.0, "impurity_scale": 1.05}
    of_settings = {"hole_velocity_low_factor": 0.9, "self_repulsion": 0.5}
    for values in ({}, of_detector | of_settings | {"hole_trapping_per_us": 0.1}):
        detector, settings = changed(**values)
        new = Simulator(detector, settings).events(hits)
        old = same.simulate(detector, settings)
        np.testing.assert_array_equal(old.waveforms, new.waveforms)
        np.testing.assert_array_equal(old.collected_kev, new.collected_kev)
        assert np.array_equal(old.waveforms, first.waveforms) == (not values)
    assert len(solved) == 1


@pytest.mark.usefixtures("own_cache")
def test_another_lithium_layer_is_solved_anew(hits: Hits) -> None:
    thick, settings = changed(li_thickness=3.0)
    same = SameHits(hits)
    lost = []
    for detector in (DETECTOR, thick):
        new = Simulator(detector, settings).events(hits)
        old = same.simulate(detector, settings)
        np.testing.assert_array_equal(old.waveforms, new.waveforms)
        np.testing.assert_array_equal(old.lost_kev, new.lost_kev)
        lost.append(new.lost_kev.sum())
    assert lost[1] > lost[0]


@pytest.mark.usefixtures("own_cache")
@pytest.mark.parametrize(
    "values",
    [
        {"temperature_K": 92.0},
        {"impurity_scale": 1.03},
        {"hole_velocity_low_factor": 0.97},
        {"cloud_fwhm_mm": 0.5},
        {"hole_trapping_per_us": 0.05},
    ],
    ids=lambda values: str(next(iter(values))),
)
def test_quick_differences_are_the_exact_ones(hits: Hits, values: dict[str, float]) -> None:
    same = SameHits(hits)
    detector, settings = changed(**values)
    change = [
        _smooth(same.simulate(detector, settings, quick=quick))
        - _smooth(same.simulate(*changed(), quick=quick))
        for quick in (False, True)
    ]
    error = np.sqrt(np.mean((change[1] - change[0]) ** 2) / np.mean(change[0] ** 2))
    assert 0 < error < 0.1


def _smooth(events: EventPulses) -> npt.NDArray[np.float64]:
    """As after the electronics, whose bandwidth sharp edges do not pass."""
    return gaussian_filter1d(events.waveforms.astype(float), 24 / SHORT.dt_ns, axis=1)
