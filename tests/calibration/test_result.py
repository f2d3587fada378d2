"""What a calibration says of its result, where the result is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cpunet.calibration.joint_problem import JointParameters
from cpunet.calibration.nuisances import Physics, named
from cpunet.calibration.result import described, notes
from cpunet.calibration.search import Calibrated
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings

NUISANCES = tuple(named(name) for name in ("temperature", "impurity", "cloud"))
PHYSICS = Physics(read_detector("ppc"), SimulationSettings(), NUISANCES)


def calibrated(values=(), given=None) -> Calibrated:
    """A calibration that ended at these values of temperature, impurity and cloud."""
    response = ElectronicsResponse(load_recipe("fast").matching[0], 16.0)
    parameters = JointParameters(response, PHYSICS, np.zeros(3), range(3), given or {})
    vector = parameters.vector()
    for i, value in enumerate(values):
        nominal = PHYSICS.nominal(NUISANCES[i])
        vector[parameters.n_chain + i] = NUISANCES[i].coordinate(nominal, value)
    parameters.set(vector)
    problem = SimpleNamespace(
        parameters=parameters,
        nearby=SimpleNamespace(simulator=SimpleNamespace(physics=PHYSICS)),
        moments=2,
        names=("first", "second"),
        by_chance=(2.0, 0.5),
        pulls=lambda _: np.zeros(2),
        residuals=lambda at: at - vector,
        jacobian=lambda at, _: np.eye(len(at)),
    )
    return Calibrated(
        problem=problem,
        covariance=1e-4 * np.eye(len(vector)),
        chi_square_before=9.0,
        pulls_before=np.zeros(2),
        chi_square=2.0,
        directions=[],
        promised={},
        errors_all=dict.fromkeys((n.name for n in NUISANCES), 0.1),
        rounds=1,
        settled=True,
    )


def test_a_prior_is_told_as_it_was_given():
    """Wherever the fit ends."""
    given = {"impurity_factor": (1.1, 0.03), "cloud_fwhm_mm": (0.5, 0.02)}
    told = described(calibrated((85.0, 1.4, 0.9), given))["parameters"]
    for name, (value, error) in given.items():
        prior = told[name]["prior"]
        assert (prior["value"], prior["error"]) == pytest.approx((value, error))
        assert prior["source"] == "given"
    default = described(calibrated((85.0, 1.4, 0.9)))["parameters"]["impurity_factor"]["prior"]
    assert (default["value"], default["error"]) == pytest.approx((1.0, 0.1))


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_parameter_at_its_bound_is_told(factor):
    """Rounding in a coordinate does not hide it."""
    told = notes(calibrated((85.0, factor)))
    assert any(note.startswith("impurity_factor is at its bound, ") for note in told)
    assert not any("temperature_K is at its bound" in note for note in told)
