"""Pulses near those that were simulated, held against a simulation there."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpunet.calibration.nearby import Derivative, Nearby, Simulator, half_maxima, move
from cpunet.calibration.nuisances import Physics, named
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings

FREE = [named(name) for name in ("temperature", "impurity", "self_repulsion")]


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    detector = read_detector("ppc", ["grid_mm=0.5"])
    rng = np.random.default_rng(2)
    place = rng.uniform([-12, -12, 5], [12, 12, 30], (30, 3))
    hits = Hits.of(place, rng.uniform(200, 1000, 30), np.arange(0, 31, 3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CPUNET_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield Simulator(hits, Physics(detector, SimulationSettings(dt_ns=4), tuple(FREE)))


def laid_over(pulses, others):
    """Pulses moved so that they pass half of their height where the others do."""
    at, there = (half_maxima(some) for some in (pulses, others))
    return move(pulses, at - there)


def test_small_changes_are_those_of_a_simulation(simulator):
    nearby = Nearby.about(simulator, np.zeros(3)).again(range(3))
    there = np.array([0.4, -0.008, 0.3])
    exact = simulator(there)
    near = nearby.at(there)
    change = laid_over(exact, nearby.base) - nearby.base
    left = laid_over(near, nearby.base) - laid_over(exact, nearby.base)
    assert np.sqrt((left**2).mean()) < 0.25 * np.sqrt((change**2).mean())


def test_derivatives_follow_the_edge(simulator):
    """Edges of a warmer detector are later, and self-repulsion smears them there."""
    warmer = np.array([0.5, 0.0, 0.0])
    fresh = Nearby.about(simulator, warmer).again([2])
    before = Nearby.about(simulator, np.zeros(3)).again([2])
    nearby = Nearby.about(simulator, warmer, before.derivatives)
    late = nearby.half - nearby.derivatives[2].half
    assert late.max() > 0.3  # samples
    far = np.argmax(late)
    followed, stale = (
        np.linalg.norm(slopes[far] - fresh.slopes[2][far])
        for slopes in (nearby.slopes[2], nearby.derivatives[2].pulses)
    )
    assert followed < 0.5 * stale


def test_only_derivatives_from_afar_are_simulated_again():
    base, far, reach = np.zeros((4, 2)), np.array([2.0, 0.1, 0.0]), np.ones(3)
    near = np.array([1.5, 0.1, 0.0])
    known = {
        0: Derivative(base, near, np.zeros(4)),
        1: Derivative(base, np.zeros(3), np.zeros(4)),
        2: Derivative(base[:3], far, np.zeros(3)),
    }
    nearby = Nearby(None, far, base, known)
    assert nearby.outdated([0, 1, 2], reach, 4) == [1, 2]  # the last of too few events
    assert nearby.outdated([1], reach, 4) == []  # what is not free does not count
    assert Nearby(None, far, base, {}).outdated([0], reach) == [0]


@given(st.floats(1, 8), st.floats(-6, 6))
def test_pulses_are_moved_where_they_are_told(width, samples):
    time = np.arange(200.0)
    pulse = (1 / (1 + np.exp(-(time - 100.3) / width)))[np.newaxis].astype(np.float32)
    assert half_maxima(pulse)[0] == pytest.approx(100.3, abs=0.1)
    moved = move(pulse, np.array([samples]))
    wanted = 1 / (1 + np.exp(-(time + samples - 100.3) / width))
    inside = slice(10, 180)
    assert np.abs(moved[0] - wanted)[inside].max() < 0.05 / width**2 + 1e-4
