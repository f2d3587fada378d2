"""What a calibration says of its result, where the result is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cpunet.calibration.calibrated_run import CalibratedPhysics, ChiSquare
from cpunet.calibration.identifiability import Linear
from cpunet.calibration.joint_problem import JointProblem
from cpunet.calibration.nearby import Nearby
from cpunet.calibration.nuisances import Physics, named
from cpunet.calibration.result import described
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from synthetic import load_recipe
from unpaired import DT_NS, charge, coarse

SHORT = ("temperature", "impurity", "cloud", "self_repulsion", "diffusion")
NUISANCES = tuple(named(name) for name in SHORT)
PHYSICS = Physics(read_detector("ppc"), SimulationSettings(), NUISANCES)


def calibrated(values=(), degenerate=False) -> CalibratedPhysics:
    """A calibration that ended at these values, in their order; others are as simulated."""
    recipe, at = load_recipe("fast"), np.zeros(5)
    response = ElectronicsResponse(recipe.matching[0], DT_NS)
    nearby = Nearby(SimpleNamespace(physics=PHYSICS), at, coarse(charge(9, seed=1)), {})
    weights = [np.eye(2)]
    problem = JointProblem(response, nearby, [*range(5)], [], recipe, response, weights=weights)
    vector = problem.vector()
    for i, value in enumerate(values):
        nominal = PHYSICS.nominal(NUISANCES[i])
        vector[problem.n_chain + i] = NUISANCES[i].coordinate(nominal, value)
    problem.set(vector)
    covariance = 1e-4 * np.eye(len(vector))
    if degenerate:
        n, widths = problem.n_chain, problem.widths[problem.n_chain :][:2]
        shares = np.array([[1, -0.99], [-0.99, 1]])
        covariance[n : n + 2, n : n + 2] = 0.64 * shares * np.outer(widths, widths)
    chi = ChiSquare(
        before=9.0, after=2.0, moments=2, expected=2.0, spread=0.5, errors_scaled_by=1.0
    )
    facts = {"others": [], "pulls_before": [0.0], "pulls_after": [0.0]}
    facts |= {"rounds": 1, "settled": True}
    none = np.zeros((2, 5))
    linear = Linear(np.eye(5), np.zeros(5), none, np.zeros(5), np.ones(5), 100.0)
    return described(problem, covariance, chi, linear, **facts)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_parameter_at_its_bound_is_told(factor):
    """Rounding in a coordinate does not hide it."""
    told = calibrated((85.0, factor)).notes
    assert any(
        "the fit uses impurity_factor" in note and "at its bound" in note for note in told
    )
    assert not any("temperature_K" in note for note in told)


@pytest.mark.parametrize(
    ("values", "name", "why"),
    [
        ((94.9,), "temperature_K", "3.3 errors of its prior"),
        ((85.0, 1.0, 1.1), "cloud_fwhm_mm", "0 to 1 is possible"),
        ((85.0, 1.0, 0.1, 2.1), "self_repulsion", "0 to 2 is possible"),
        ((85.0, 1.0, 0.1, 0.0, 0.14), "diffusion_constant", "0.06 to 0.13 is possible"),
        ((85.0, 1.0, 0.1, 0.0, 0.05), "diffusion_constant", "0.06 to 0.13 is possible"),
    ],
)
def test_what_cannot_be_is_no_finding(values, name, why):
    """In remarks, numbers, and the files that hold the physics."""
    result = calibrated(values)
    doubts = {n: each.doubt for n, each in result.parameters.items() if each.doubt}
    assert [*doubts] == [name]
    assert why in doubts[name]
    assert any(
        note.startswith(f"the fit uses {name} = ")
        and "to make up for something else" in note
        and "`prior`" in note
        for note in result.notes
    )
    assert not any("no other physics are needed" in note for note in result.notes)
    assert result.comment.startswith(f"# {name}: unreliable value, makes up for something")
    assert result.comment.count("\n") == 1


def test_of_a_degenerate_pair_the_direction_is_told():
    (pair,) = calibrated((93.0, 1.05), degenerate=True).together
    assert pair.components == pytest.approx(
        {"temperature_K": 0.5**0.5, "impurity_factor": 0.5**0.5}
    )
    assert pair.value == pytest.approx((8 / 3 + np.log(1.05) / 0.1) / 2**0.5)
    assert pair.error == pytest.approx(0.08)
