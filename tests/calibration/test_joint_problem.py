"""The comparison that chain and physics minimise together, where the answer is known.

Pulses are two numbers here, and the functions are these numbers, so that means, covariances
and derivatives follow from the definition.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numba
import numpy as np
import pytest

from cpunet.calibration import joint_problem
from cpunet.calibration.identifiability import Information
from cpunet.calibration.joint_problem import HOLD, RIDGE, JointParameters, JointProblem
from cpunet.calibration.nearby import Derivative, Nearby, half_maxima
from cpunet.calibration.nuisances import Physics, named
from cpunet.calibration.sliced_functions import SlicedFunctions
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.training.chain_parameters import STRETCH, with_decay, with_settings
from cpunet.training.moments import Readings
from cpunet.training.pulse_sets import PulseSets
from synthetic import load_recipe
from unpaired import CHAIN, DT_NS, charge, coarse, faster, measured_with

RECIPE = load_recipe("fast")
PHYSICS = Physics(
    read_detector("ppc"), SimulationSettings(), (named("temperature"), named("impurity"))
)
PAIRS, SLOPES = 400, {0: np.array([0.02, -0.01]), 1: np.array([1.0, 3.0])}


@dataclass
class Pairs:
    """Simulated pulses that no readout changes: two numbers each."""

    sim: np.ndarray
    weights: np.ndarray
    length = 800

    def __len__(self):
        return len(self.sim)

    def of(self, rows):
        return Pairs(self.sim[rows], self.weights[rows])

    def sums(self, response, of, *, cut=True, draws=None):
        readings = Readings(self.sim, np.zeros(len(self)), self.weights)
        return of(readings), float(self.weights.sum())


class ReadExactly:
    """The derivatives of these numbers: no readout changes them, but the physics do."""

    def __init__(self, side):
        self.side = side

    def slopes(self, ways, functions, *, draws=None):
        changes = ways.of_pulses(slice(None))
        of_chain = np.zeros((len(ways.of_transfer), self.side.sim.shape[1]))
        return np.concatenate([of_chain, changes.mean(axis=1)]).T


@pytest.fixture
def read_exactly(monkeypatch):
    monkeypatch.setattr(joint_problem, "DifferentiableSet", ReadExactly)


class Plain(JointProblem):
    """The problem with pulses that need no preparation."""

    def windows(self, coordinates, most=None):
        return self.nearby.at(coordinates, most)


class Numbers:
    """The functions: the numbers themselves."""

    names = ("first", "second")

    def __call__(self, readings, clip=None):
        return readings.linear


def problem(sim, data, *, free=(0, 1), held=False, known=None, centre=(0.0, 0.0)):
    response = ElectronicsResponse(RECIPE.matching[0], 16.0)
    at = np.array(centre)
    parameters = JointParameters(response, PHYSICS, at, free, {}, response)
    simulator = SimpleNamespace(physics=PHYSICS)
    nearby = Nearby(simulator, at, sim, {})
    slopes = {
        i: Derivative(np.tile(slope, (len(sim), 1)), at, nearby.half)
        for i, slope in SLOPES.items()
    }
    nearby = replace(nearby, derivatives=slopes)
    ones = np.ones(len(sim))
    band = SimpleNamespace(
        name="FEP",
        sim=Pairs(sim, ones),
        rows=np.arange(len(sim)),
        moments=SimpleNamespace(data=Readings(data, np.zeros(len(data)), np.ones(len(data)))),
        pairs=1 / (1 / len(data) + 1 / len(sim)),
    )
    more = {} if known is None else {"known": known}
    return Plain(parameters, [band], [Numbers()], nearby, RECIPE, **more, held=held)


@pytest.fixture(scope="module")
def sides():
    rng = np.random.default_rng(3)
    mixed = np.array([[1.0, 0.6], [0.0, 0.8]])
    return 2 * rng.normal(size=(PAIRS, 2)) @ mixed, 0.3 + rng.normal(size=(PAIRS, 2)) @ mixed


def whitened(deviation, covariance):
    """Chi-square of deviations by its definition, with the shrunk correlations."""
    sigma = np.sqrt(covariance.diagonal())
    correlation = (1 - RIDGE) * covariance / np.outer(sigma, sigma) + RIDGE * np.eye(2)
    pull = deviation / sigma
    return pull @ np.linalg.solve(correlation, pull)


def test_chi_square_is_that_of_the_definition(sides):
    sim, data = sides
    both = problem(sim, data)
    covariance = 0.5 * (np.cov(sim.T, bias=True) + np.cov(data.T)) / (PAIRS / 2)
    deviation = sim.mean(axis=0) - data.mean(axis=0)
    assert both.chi_square() == pytest.approx(whitened(deviation, covariance))
    assert both.pulls() == pytest.approx(deviation / np.sqrt(covariance.diagonal()))
    assert both.moments == 2
    assert both.names == ("first", "second")


def test_chance_gives_less_than_one_per_function_because_of_the_ridge(sides):
    both = problem(*sides)
    mean, spread = both.by_chance
    covariance = sum(np.cov(side.T, bias=i == 0) for i, side in enumerate(sides))
    drawn = np.random.default_rng(1).multivariate_normal([0, 0], covariance, 400_000)
    sigma = np.sqrt(covariance.diagonal())
    correlation = (1 - RIDGE) * covariance / np.outer(sigma, sigma) + RIDGE * np.eye(2)
    pulls = drawn / sigma
    chi_square = (pulls @ np.linalg.inv(correlation) * pulls).sum(axis=1)
    assert mean == pytest.approx(chi_square.mean(), rel=0.01)
    assert mean < 1.98
    assert spread == pytest.approx(chi_square.std(), rel=0.01)


def test_far_from_the_data_only_their_covariance_counts(sides):
    sim, data = sides
    held = problem(sim, data, held=True)
    deviation = sim.mean(axis=0) - data.mean(axis=0)
    expected = whitened(deviation, np.cov(data.T) / (PAIRS / 2))
    assert held.chi_square() == pytest.approx(expected)
    near = problem(sim, data)
    near.weigh_like(held)
    assert near.chi_square() == pytest.approx(expected)


def test_priors_and_further_knowledge_follow_the_deviations(sides):
    known = problem(*sides, known=lambda coordinates: 7 * coordinates[:1])
    parameters = known.parameters
    vector = parameters.vector()
    vector[parameters.n_chain :] = 1.5, 0.02
    found = known.residuals(vector)
    prior = found[known.moments : known.moments + len(vector)]
    assert prior[parameters.n_chain :] == pytest.approx([1.5 / 3.0, 0.02 / 0.1])
    assert not prior[: parameters.n_chain].any()
    assert found[-1] == pytest.approx(10.5)
    assert parameters.coordinates.tolist() == [1.5, 0.02]


def test_what_else_is_known_makes_errors_smaller(sides, read_exactly):
    plain = problem(*sides)
    known = problem(*sides, known=lambda coordinates: 500 * coordinates[1:])
    before, after = (
        Information.of(one, one.jacobian(one.parameters.vector())) for one in (plain, known)
    )
    own = before.errors([1])[0]
    assert after.errors([1])[0] == pytest.approx((own**-2 + 500**2) ** -0.5, rel=1e-6)
    assert after.errors()[0] < 0.95 * before.errors()[0]  # what was alike is told apart
    few = after.for_pulses(1e-9)
    assert few.errors() == pytest.approx([3.0, (0.1**-2 + 500**2) ** -0.5], rel=1e-4)
    np.testing.assert_allclose(after.matrix, before.matrix, rtol=1e-4)


def test_steps_from_far_away_are_held_within_reach(sides):
    held = problem(*sides, held=True, centre=(1.0, 0.0))
    vector = held.parameters.vector()
    vector[-2:] = 1.0 + PHYSICS.nuisances[0].reach, -0.5 * PHYSICS.nuisances[1].reach
    assert held.residuals(vector)[-2:] == pytest.approx([HOLD, -0.5 * HOLD])


def test_derivatives_are_those_of_the_pulses(sides, read_exactly):
    both = problem(*sides)
    vector = both.parameters.vector()
    jacobian = both.jacobian(vector)
    n, sigma = both.parameters.n_chain, both._sigma[0]
    for column, slope in SLOPES.items():
        expected = both._whiten[0] @ (slope / sigma)
        assert jacobian[:2, n + column] == pytest.approx(expected, rel=1e-6)
    assert not jacobian[:2, :n].any()  # these pulses know no readout
    priors = jacobian[2:].diagonal()
    assert priors == pytest.approx(1 / both.parameters.widths)
    assert both.parameters.vector() == pytest.approx(vector, rel=1e-12)


def test_derivatives_are_those_of_wide_differences(monkeypatch):
    """Of chain, stretch and physics: a drift that takes longer, and a wider cloud.

    Noise makes the readings of single pulses jump; over wide steps of many that is a motion.
    """
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)  # which share one response
    n = 3000
    sides = measured_with(CHAIN, n)
    sets = PulseSets(*sides, RECIPE, np.random.default_rng(0))
    (band,) = sets.bands()
    fine = charge(n, seed=1)
    base = coarse(fine)
    half = half_maxima(base, np.zeros(n))
    wider = sum(np.roll(base, shift, axis=1) for shift in (-1, 1)) - 2 * base
    slopes, at = (coarse(faster(fine, 0.9)) - base, wider), np.zeros(2)
    derivatives = {i: Derivative(np.float32(s), at, half) for i, s in enumerate(slopes)}
    nearby = Nearby(SimpleNamespace(physics=PHYSICS), at, base, derivatives)
    response = with_settings(ElectronicsResponse(RECIPE.matching[0], DT_NS), drift_terms=1)
    response.drift.stretch[...] = 0.05
    with_decay(response, band.moments.slope)
    parameters = JointParameters(response, PHYSICS, at, [0, 1], {}, response)
    functions = [SlicedFunctions(band.moments)]
    both = JointProblem(parameters, [band], functions, nearby, RECIPE)
    vector = parameters.vector()
    for i, slope in enumerate(both.jacobian(vector).T):
        step, ends = 3 / np.linalg.norm(slope), []  # by three standard deviations in all
        for sign in (1, -1):
            there = vector.copy()
            there[i] += sign * step
            ends.append(both.residuals(there))
        wanted = (ends[0] - ends[1]) / (2 * step)
        # a stretch moves the half maxima of all pulses, which jump more
        most = 0.25 if parameters.chain.labels[i:] == [STRETCH] else 0.1
        assert np.linalg.norm(slope - wanted) < most * np.linalg.norm(wanted)
    of_chain, n = both.of_chain(response), parameters.n_chain
    whole, chain = (one.jacobian(one.parameters.vector()) for one in (both, of_chain))
    np.testing.assert_allclose(chain[: both.moments], whole[: both.moments, :n], rtol=1e-6)


def test_windows_do_not_jump_where_the_alignment_of_pulses_does(sides):
    """Noise begins with a window, so that a jump by a sample would change it."""
    one, time = problem(*sides), np.arange(1200.0)
    flat = np.linspace(100, 101, 21)[:, np.newaxis]  # samples to the flat top
    base, longer = (np.clip((time - 450) / (flat + x), 0, 1) for x in (0.0, 1.0))
    base, slope = base.astype(np.float32), (longer - base).astype(np.float32)
    centre = np.zeros(2)
    slopes = {0: Derivative(slope, centre, half_maxima(base, np.zeros(len(base))))}
    one.nearby = Nearby(one.nearby.simulator, centre, base, slopes)

    def prepared(x):
        at = Pulses.of(one.nearby.at(np.array([x, 0.0])), dt_ns=16)
        return prepare(at, RECIPE.preparation, "simulated")

    here, one_more = (JointProblem.windows(one, np.array([x, 0.0])) for x in (0.0, 1.0))
    assert here == pytest.approx(prepared(0.0).pulses.waveforms, abs=1e-6)
    for x in (-0.02, 0.02, 0.3):
        there = JointProblem.windows(one, np.array([x, 0.0]))
        # a jump by a sample is 0.01; the scale to a highest value of 1 changes by 1e-4
        assert there == pytest.approx(here + x * (one_more - here), abs=2e-4)
    assert (prepared(0.3).align_sample != prepared(0.0).align_sample).any()


def test_what_is_not_free_stays(sides):
    one = problem(*sides, free=[1], centre=(1.0, 0.0))
    parameters = one.parameters
    assert parameters.names[-1] == "impurity_factor"
    vector = parameters.vector()
    vector[-1] = 1e3  # far beyond its bound
    one.residuals(vector)
    assert parameters.coordinates[0] == 1.0
    assert parameters.coordinates[1] == pytest.approx(np.log(PHYSICS.nuisances[1].highest))
