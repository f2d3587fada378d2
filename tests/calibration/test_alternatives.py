"""Predictions for energies that were not used, where physics say what they must be."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cpunet.calibration.alternatives import side_by_side
from cpunet.calibration.nuisances import Physics, named
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.peaks import parse_selection
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from synthetic import load_recipe

RECIPE = load_recipe("fast")
BOTH = tuple(named(f"hole_velocity_{field}") for field in ("low", "high"))
PHYSICS = Physics(read_detector("ppc"), SimulationSettings(), BOTH)
SEP_KEV, N = 2103.5, 120


@pytest.fixture(scope="module")
def hits() -> Hits:
    """Single sites far from the contact: of the single-escape peak, and of full energy."""
    z = np.linspace(15.0, 25.0, N)
    sites = np.stack([np.full(2 * N, 15.0), np.zeros(2 * N), np.tile(z, 2)], axis=1)
    return Hits.of(sites, np.repeat([SEP_KEV, 2614.5], N), np.arange(2 * N + 1))


def physics(factor: float) -> SimpleNamespace:
    """All holes faster by a factor, and one chain."""
    return SimpleNamespace(
        nearby=SimpleNamespace(simulator=SimpleNamespace(physics=PHYSICS)),
        parameters=SimpleNamespace(
            coordinates=np.full(2, np.log(factor)),
            free=[0, 1],
            chain=SimpleNamespace(response=ElectronicsResponse(RECIPE.matching[0], 16.0)),
        ),
    )


def test_slower_holes_drift_longer_and_that_decides(hits):
    used = parse_selection("FEP", RECIPE.peaks)
    fits = (physics(1.0), 0.0), (physics(0.8), 2.5)
    (here, slower), deciding = side_by_side(fits, hits, RECIPE, used)
    assert slower["hole_velocity_low_factor"] == pytest.approx(0.8)
    assert (here["chi_square_rise"], slower["chi_square_rise"]) == (0.0, 2.5)
    # no other energies, and the full-energy peak was used
    assert {name.split("_")[0] for name in here} == {"hole", "chi", "SEP"}
    # holes take 1 / 0.8 as long, and at these sites the pulse is theirs
    ratio = slower["SEP_drift_time"] / here["SEP_drift_time"]
    assert ratio == pytest.approx(1 / 0.8, abs=0.04)
    assert slower["SEP_current_amplitude"] < here["SEP_current_amplitude"]
    assert deciding == ["SEP"]
