"""Events: sums of hits, lost energy, and the library against the exact drift."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cpunet.simulation.events import simulate_events
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.signals import hit_signals

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


SETTINGS = SimulationSettings(length_ns=2400, library_grid_mm=1.5)


def test_an_event_is_the_weighted_sum_of_its_hits() -> None:
    place = [[1.0, 2.0, 5.0], [6.0, 0.0, 9.0], [0.0, 0.0, 0.5]]
    hits = Hits.of(place, [300.0, 100.0, 50.0], [0, 3, 3])
    seen: list[tuple[int, int]] = []
    events = simulate_events(
        planar(), hits, SETTINGS, progress=lambda done, n: seen.append((done, n))
    )
    single = hit_signals(planar(), *np.transpose(place), 1.0, SETTINGS).waveforms
    np.testing.assert_allclose(
        events.waveforms[0], 0.75 * single[0] + 0.25 * single[1], atol=1e-6
    )
    assert events.lost_kev.tolist() == [50.0, 0.0]
    assert events.collected_kev.tolist() == [400.0, 0.0]
    assert events.counts["hits without signal"] == 1
    assert events.counts["events without signal"] == 1
    assert len(events.pulses()) == 1
    assert events.pulses().energy_kev.tolist() == [400.0]
    assert seen[-1] == (2, 2)


def test_library_agrees_with_the_exact_drift(reference_data: Path) -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform([-38, -38, 1], [38, 38, 94], (600, 3))
    hits = Hits.of(place, rng.uniform(50, 1000, 600), np.arange(0, 601, 3))
    maps = reference_maps(reference_data)
    exact = simulate_events(maps, hits, SETTINGS)
    quick = simulate_events(maps, hits, SETTINGS, mode="library")
    np.testing.assert_allclose(exact.lost_kev, quick.lost_kev)
    kept = exact.collected_kev > 0
    difference = quick.waveforms[kept] - exact.waveforms[kept]
    assert np.sqrt(np.mean(difference**2)) < 1e-3
    current = [np.diff(e.waveforms[kept], axis=1).max(axis=1) for e in (exact, quick)]
    assert np.median(np.abs(current[1] / current[0] - 1)) < 0.005
