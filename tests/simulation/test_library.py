"""Libraries against drifting; the same hits with other physics."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from cpunet.simulation import again
from cpunet.simulation.again import SameHits
from cpunet.simulation.events import (
    COLLECTED,
    INTERPOLATED,
    NO_SIGNAL,
    NOT_COLLECTED,
    EventPulses,
    simulate_events,
)
from cpunet.simulation.fields import FieldMaps, compute_fields
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.library import build_library
from cpunet.simulation.library_lookup import PulseLibrary, add_pulse, covers
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.signals import hit_signals

Array = npt.NDArray[np.float64]

# few halvings: more cells are left to the drift, those that are used are as good
SETTINGS = SimulationSettings(length_ns=2400, library_grid_mm=4, library_halvings=2)
FINE = SETTINGS.model_copy(update={"library_grid_mm": 1.0})


@pytest.fixture(scope="module")
def library(planar: FieldMaps) -> PulseLibrary:
    return build_library(planar, FINE)


def random_events(
    size: tuple[float, float], n_hits: int, seed: int = 0, above: float = 0.0
) -> Hits:
    """Events of three hits within a radius and a height, above a plane."""
    rng = np.random.default_rng(seed)
    place = rng.uniform([-size[0], -size[0], 0], [size[0], *size], (n_hits, 3))
    place[:, 2] += above
    return Hits.of(place, rng.uniform(50, 1000, n_hits), np.arange(0, n_hits + 1, 3))


def largest_rise(events: EventPulses, kept: npt.NDArray[np.bool_]) -> Array:
    return np.diff(events.waveforms[kept].astype(float), axis=1, prepend=0).max(axis=1)


def test_an_event_is_the_weighted_sum_of_its_hits(planar: FieldMaps) -> None:
    place = [[1.0, 2.0, 5.0], [6.0, 0.0, 9.0], [0.0, 0.0, 0.5]]
    hits = Hits.of(place, [300.0, 100.0, 50.0], [0, 3, 3])
    events = simulate_events(planar, hits, SETTINGS)
    single = hit_signals(planar, *np.transpose(place), 1.0, SETTINGS).waveforms
    np.testing.assert_allclose(
        events.waveforms[0], 0.75 * single[0] + 0.25 * single[1], atol=1e-6
    )
    assert events.lost_kev.tolist() == [50.0, 0.0]
    assert events.collected_kev.tolist() == [400.0, 0.0]
    assert events.outcome.tolist() == [COLLECTED, COLLECTED, NO_SIGNAL]
    assert len(events.pulses()) == 1
    assert events.pulses().energy_kev.tolist() == [400.0]


@pytest.mark.parametrize(
    ("size", "above", "n_hits"),
    [((10, 20), 60, 360), pytest.param((40, 96), 0, 1800, marks=pytest.mark.slow)],
    ids=["of a part", "of the crystal"],
)
@pytest.mark.thorough
def test_library_agrees_with_the_exact_drift(
    reference_maps: FieldMaps, size: tuple[float, float], above: float, n_hits: int
) -> None:
    hits = random_events(size, n_hits, above=above)
    exact = simulate_events(reference_maps, hits, SETTINGS)
    quick = simulate_events(
        reference_maps, hits, SETTINGS, build_library(reference_maps, SETTINGS)
    )
    np.testing.assert_array_equal(exact.lost_kev, quick.lost_kev)
    assert np.mean(quick.outcome[quick.outcome != NO_SIGNAL] == INTERPOLATED) > 0.7
    kept = exact.collected_kev > 0
    difference = quick.waveforms[kept] - exact.waveforms[kept]
    assert np.sqrt(np.mean(difference**2, axis=1)).max() < 1e-3
    rise = np.abs(largest_rise(quick, kept) / largest_rise(exact, kept) - 1)
    assert np.quantile(rise, 0.99) < 0.005
    assert rise.max() < 0.01


@pytest.mark.thorough
@pytest.mark.parametrize(
    "changed",
    [
        {"dt_ns": 1.0, "length_ns": 1200.0},
        {"dt_ns": 10.0, "library_step_ns": 3.0},
        {"diffusion": False, "cloud_fwhm_mm": 0.0},
        {"diffusion_constant": "siggen", "cloud_fwhm_mm": 1.0},
        {"self_repulsion": True},
    ],
    ids=lambda changed: ", ".join(changed),
)
def test_library_follows_the_settings(planar: FieldMaps, changed: dict[str, object]) -> None:
    settings = SimulationSettings(**{**FINE.model_dump(), **changed})
    hits = random_events((14, 14), 600)
    exact = simulate_events(planar, hits, settings)
    quick = simulate_events(planar, hits, settings, build_library(planar, settings))
    assert np.sum(quick.outcome == INTERPOLATED) > 100
    # siggen rounds the cloud's duration, by half a step at most
    limit = 0.01 if "diffusion_constant" in changed else 0.005
    assert np.abs(quick.waveforms - exact.waveforms).max() < limit


@given(st.floats(0, 19), st.floats(-7, 7), st.floats(2.2, 11.8), st.integers(0, 3))
@examples(max_examples=50)
def test_a_pulse_of_the_library_is_that_of_its_place(
    planar: FieldMaps, library: PulseLibrary, r: float, phi: float, z: float, delay: int
) -> None:
    hit = np.array([r * np.cos(phi), r * np.sin(phi), z, 500.0])
    if not covers(library, *hit):
        return
    out = np.zeros(SETTINGS.n_samples, np.float32)
    steps = np.zeros(SETTINGS.n_samples + 1)
    add_pulse(library, hit, 2.0, delay * library.phases, out, steps)
    pulse = out + np.cumsum(steps[:-1])
    exact = 2 * hit_signals(planar, *hit[:, None], SETTINGS).waveforms[0]
    late = np.concatenate([exact[delay:], np.full(delay, exact[-1])])
    np.testing.assert_allclose(pulse, late, atol=0.01)


@pytest.mark.thorough
def test_what_misses_the_tolerance_is_drifted(planar: FieldMaps) -> None:
    hits = random_events((14, 14), 600)
    exact = simulate_events(planar, hits, SETTINGS)
    interpolated, deviation = [], []
    for tolerance in (1e-9, 3e-3, 3e-1):
        settings = FINE.model_copy(update={"library_tolerance": tolerance})
        quick = simulate_events(planar, hits, settings, build_library(planar, settings))
        interpolated.append(np.sum(quick.outcome == INTERPOLATED))
        deviation.append(np.abs(quick.waveforms - exact.waveforms).max())
    assert interpolated[0] == 0
    assert deviation[0] < 1e-6
    assert 0 < interpolated[1] < interpolated[2]
    assert deviation[1] < deviation[2]


def test_charges_that_come_too_late_are_drifted_and_counted(planar: FieldMaps) -> None:
    short = FINE.model_copy(update={"length_ns": 64.0})
    hits = random_events((14, 14), 600)
    exact = simulate_events(planar, hits, short)
    quick = simulate_events(planar, hits, short, build_library(planar, short))
    late = exact.outcome == NOT_COLLECTED
    assert 0 < late.sum() == np.sum(quick.outcome == NOT_COLLECTED)
    assert np.abs(quick.waveforms - exact.waveforms).max() < 0.005


DETECTOR = read_detector("ppc", ["grid_mm=0.5"])
SHORT = SimulationSettings(length_ns=1600)


@pytest.fixture(scope="module")
def hits() -> Hits:
    """Events of three hits, one of them often in the lithium layer."""
    rng = np.random.default_rng(1)
    size = [DETECTOR.crystal_radius / 1.4, DETECTOR.crystal_radius / 1.4]
    low, high = [-size[0], -size[1], 0], [*size, DETECTOR.crystal_length]
    place = rng.uniform(low, high, (120, 3))
    return Hits.of(place, rng.uniform(50, 1000, 120), np.arange(0, 121, 3))


def changed(**values: Any) -> tuple[Detector, SimulationSettings]:
    of_detector = {k: v for k, v in values.items() if k in Detector.model_fields}
    of_settings = {k: v for k, v in values.items() if k not in of_detector}
    detector = DETECTOR.model_copy(update=of_detector)
    return detector, SHORT.model_copy(update=of_settings)


PHYSICS = [
    {},
    {"temperature_K": 95.0, "bias_V": 2600.0, "impurity_scale": 1.05},
    {"impurity_tilt_1e10_per_cm4": 0.02},
    {"hole_velocity_low_factor": 0.9, "electron_velocity_high_factor": 1.1},
    {"self_repulsion": 0.5, "hole_trapping_per_us": 0.1},
]


@pytest.mark.usefixtures("own_cache")
@pytest.mark.parametrize(
    "physics",
    [[{}, {**PHYSICS[1], **PHYSICS[4]}], pytest.param(PHYSICS, marks=pytest.mark.slow)],
    ids=["two", "all"],
)
def test_it_is_a_new_simulation_from_one_solution(
    hits: Hits, monkeypatch: pytest.MonkeyPatch, physics: list[dict[str, float]]
) -> None:
    solved: list[Detector] = []
    solve = again.solve
    monkeypatch.setattr(again, "solve", lambda d: solved.append(d) or solve(d))
    same = SameHits(hits)
    first = same.simulate(DETECTOR, SHORT)
    for values in physics:
        detector, settings = changed(**values)
        new = simulate_events(compute_fields(detector), hits, settings)
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
        new = simulate_events(compute_fields(detector), hits, settings)
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
