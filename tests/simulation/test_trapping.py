"""Trapped charge: Hecht's formula in a uniform field, and what it takes off an energy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from cpunet.simulation.events import simulate_events
from cpunet.simulation.field_lookup import Maps
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.signals import hit_signals
from cpunet.simulation.velocity import ELECTRON, HOLE, drift_velocity, velocity_table

Array = npt.NDArray[np.float64]

RATES = {"hole_trapping_per_us": 2.0, "electron_trapping_per_us": 5.0}
PLAIN = SimulationSettings(
    dt_ns=1, library_step_ns=1, length_ns=2400, diffusion=False, cloud_fwhm_mm=0
)


def hecht(t_ns: Array, path_mm: float, carrier: int, rate_per_us: float) -> Array:
    """Signal (of full scale) of a carrier that drifts `path_mm` of 10 mm at 1000 V/cm."""
    speed = abs(drift_velocity(velocity_table(90), [[0, 0, -1000.0]], carrier)[0, 2])
    rate = rate_per_us / 1000
    return speed / rate / 10 * -np.expm1(-rate * np.minimum(t_ns, path_mm / speed))


@pytest.mark.parametrize("z", [3.0, 8.0, 11.5])
def test_a_uniform_field_follows_hecht(planar: Maps, z: float) -> None:
    trapping = PLAIN.model_copy(update=RATES)
    signals = hit_signals(planar, [0.0], [0.0], [z], [100.0], trapping)
    t = np.arange(PLAIN.n_samples, dtype=float)
    expected = hecht(t, z - 2, HOLE, 2.0) + hecht(t, 12 - z, ELECTRON, 5.0)
    np.testing.assert_allclose(signals.waveforms[0], expected, atol=1e-3)
    assert signals.trapped[0] == pytest.approx(1 - expected[-1], abs=2e-4)


def test_trapped_charge_lowers_the_energy_and_not_the_pulse(planar: Maps) -> None:
    places = [[0.0, 0.0, 4.0], [0.0, 0.0, 10.0], [0.0, 0.0, 0.5]]
    hits = Hits.of(places, [400.0, 600.0, 50.0], [0, 3])
    events = simulate_events(planar, hits, PLAIN.model_copy(update=RATES))
    t = np.array([1e5])
    kept = [hecht(t, z - 2, HOLE, 2.0) + hecht(t, 12 - z, ELECTRON, 5.0) for z in (4.0, 10.0)]
    collected = 400 * kept[0][0] + 600 * kept[1][0]
    assert events.lost_kev[0] == 50
    assert events.trapped_kev[0] == pytest.approx(1000 - collected, abs=0.2)
    assert events.pulses().energy_kev[0] == pytest.approx(collected, abs=0.2)
    assert events.waveforms[0, -1] == pytest.approx(1, abs=1e-4)
    without = simulate_events(planar, hits, PLAIN)
    assert without.trapped_kev[0] == 0


def test_the_library_traps_as_much(planar: Maps) -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform([-14, -14, 2], [14, 14, 12], (300, 3))
    hits = Hits.of(place, rng.uniform(50, 1000, 300), np.arange(0, 301, 3))
    settings = SimulationSettings(
        length_ns=2400, library_grid_mm=1, library_halvings=2, **RATES
    )
    exact = simulate_events(planar, hits, settings)
    quick = simulate_events(planar, hits, settings, mode="library")
    assert quick.counts["hits interpolated"] > 100
    share = exact.trapped_kev / exact.energy_kev
    assert share.min() > 0.01
    np.testing.assert_allclose(quick.trapped_kev / exact.energy_kev, share, atol=5e-4)
    assert np.abs(quick.waveforms - exact.waveforms).max() < 0.006
