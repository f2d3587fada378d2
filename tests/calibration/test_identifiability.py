"""Degenerate parameters where the answer is known, and what a calibration says of them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cpunet.calibration.calibrated_run import CalibratedPhysics, ChiSquare
from cpunet.calibration.identifiability import Linear, together
from cpunet.calibration.joint_problem import JointProblem
from cpunet.calibration.nearby import Nearby
from cpunet.calibration.nuisances import Physics, named
from cpunet.calibration.result import described, of_parts, of_weights
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from synthetic import load_recipe
from unpaired import DT_NS, charge, coarse

NUISANCES = tuple(named(name) for name in ("temperature", "hole_velocity_low", "cloud"))
WIDTHS = np.array([n.prior for n in NUISANCES])
ROWS, ACTS = 200, 2
SHORT = ("temperature", "impurity", "cloud", "self_repulsion", "diffusion")
FREE = tuple(named(name) for name in SHORT)
PHYSICS = Physics(read_detector("ppc"), SimulationSettings(), FREE)
EVENTS, FUNCTIONS, PARTS, TRUE = 240, 60, 8, 0.3


@pytest.fixture
def alike() -> Linear:
    """Temperature and velocity move functions alike, but for a little; the cloud none."""
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(2, 50))
    columns = [30 * one, 30 * one + 0.1 * other, np.zeros(50)]
    jacobian = np.concatenate([np.stack(columns, axis=1) / WIDTHS, np.diag(1 / WIDTHS)])
    return Linear(jacobian, np.zeros(53), np.zeros((2, 50)), np.zeros(3), WIDTHS, 1000.0)


def test_what_moves_pulses_alike_is_one_direction(alike):
    best, second, third = alike.directions([n.name for n in NUISANCES])
    assert best.error < 0.01
    pairs = [
        [one.components[name] for name in ("temperature_K", "hole_velocity_low_factor")]
        for one in (best, second)
    ]
    assert pairs[0] == pytest.approx([0.7, 0.7], abs=0.05)
    assert second.error > 0.3
    assert np.prod(pairs[1]) == pytest.approx(-0.5, abs=0.05)
    assert third.error == pytest.approx(1)
    assert third.components["cloud_fwhm_mm"] == pytest.approx(1)
    assert best.words.startswith("0.7")


@pytest.mark.parametrize(("correlation", "n"), [(-0.99, 1), (0.99, 1), (0.5, 0)])
def test_a_degenerate_pair_is_told_as_its_known_combination(correlation, n):
    covariance = np.eye(3)
    covariance[:2, :2] = 0.64 * np.array([[1, correlation], [correlation, 1]])
    covariance[2, 2] = 0.01
    found = together(["a", "b", "c"], covariance, np.zeros(3))
    assert len(found) == n
    for pair in found:
        combination = np.array([pair.components["a"], pair.components["b"], 0])
        assert combination @ covariance @ combination == pytest.approx(pair.error**2)
        assert pair.error == pytest.approx(0.8 * 0.1)
    # both known far better than before: two numbers
    assert not together(["a", "b"], 0.01 * covariance[:2, :2], np.zeros(2))


def selection(seed=0, size=6.0, begun=0.0) -> Linear:
    """A chain of one column, and four of physics, of which the third acts with a size."""
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(ROWS, 5)) / np.sqrt(ROWS)
    effect = size * columns[:, 1 + ACTS]
    # a half varies twice as much as all pulses, which are the mean of both halves
    halves = effect + np.sqrt(2) * rng.normal(size=(2, ROWS))
    weak = 1e-6 * np.eye(5)  # priors
    at = np.array([0.0, begun, 0.0, 0.0])
    residuals = np.concatenate([halves.mean(axis=0), np.zeros(5)])
    rows = np.concatenate([columns, weak])
    return Linear(rows, residuals, halves, at, np.full(5, 1e6), 1000.0)


def test_the_one_that_acts_describes_held_out_pulses_better():
    """On average by the fall of chi-square of all pulses, less the price of 2."""
    problems = map(selection, range(200))
    gains = np.array([[one.score([]) - one.score([i]) for i in range(4)] for one in problems])
    error = gains.std(axis=0) / np.sqrt(len(gains))
    expected = np.array([-2.0, -2.0, 36.0 - 2.0, -2.0])
    assert np.abs(gains.mean(axis=0) - expected) == pytest.approx(0, abs=0.1 * 36)
    assert (np.abs(gains.mean(axis=0) - expected)[[0, 1, 3]] < 4 * error[[0, 1, 3]]).all()


def test_costs_are_those_of_a_direct_fit():
    one = selection(begun=0.7)
    cost, there = one.cost([ACTS])
    # the one that had moved, and is not chosen, goes back to where it was simulated
    begun = one.residuals - 0.7 * one.jacobian[:, 2]
    columns = one.jacobian[:, [0, 1 + ACTS]]
    move = np.linalg.lstsq(columns, -begun)[0]
    assert cost == pytest.approx(float(np.sum((begun + columns @ move) ** 2)))
    assert there == pytest.approx([0, 0, move[1], 0])


def test_what_is_told_begins_with_what_held_out_pulses_need():
    """Of two parameters that act alike, only the first taken is determined."""
    widths = WIDTHS[:2]
    rng = np.random.default_rng(2)
    common, other = rng.normal(size=(2, ROWS))
    # alike, but the second one describes the pulses
    columns = np.stack([common, common + 0.05 * other], axis=1)
    deviation = 30 * columns[:, 1]
    halves = deviation + rng.normal(size=(2, ROWS))
    rows = np.concatenate([columns / widths, np.diag(1 / widths)])
    residuals = np.concatenate([halves.mean(axis=0), np.zeros(2)])
    assert Linear(rows, residuals, halves, np.zeros(2), widths, 1.0).begin() == [1]


def calibrated(values) -> CalibratedPhysics:
    """A calibration that ended at these values, in their order; others are as simulated."""
    recipe, at = load_recipe("fast"), np.zeros(5)
    response = ElectronicsResponse(recipe.matching[0], DT_NS)
    nearby = Nearby(SimpleNamespace(physics=PHYSICS), at, coarse(charge(9, seed=1)), {})
    weights = [np.eye(2)]
    problem = JointProblem(response, nearby, [*range(5)], [], recipe, response, weights=weights)
    vector = problem.vector()
    for i, value in enumerate(values):
        nominal = PHYSICS.nominal(FREE[i])
        vector[problem.n_chain + i] = FREE[i].coordinate(nominal, value)
    problem.set(vector)
    covariance = 1e-4 * np.eye(len(vector))
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
    begin, *parts = f"the fit uses {name} = ", "to make up for something else", "`prior`"
    assert any(n.startswith(begin) and all(p in n for p in parts) for n in result.notes)
    assert not any("no other physics are needed" in note for note in result.notes)
    assert result.comment.startswith(f"# {name}: unreliable value, makes up for something")
    assert result.comment.count("\n") == 1


def estimate(rng: np.random.Generator) -> tuple[float, float, float, float]:
    """One parameter, and its error: of least squares, and without sampling noise.

    The functions of a simulated event spread more with a larger parameter, so that the noise
    of deviations and derivatives goes together; the effect on their means is weak.
    """
    effect = np.full(FUNCTIONS, 0.03)  # on the mean of a function, of a spread of 1
    data = rng.normal(TRUE * effect, 1.0, (EVENTS, FUNCTIONS)).mean(axis=0)
    noise = rng.normal(size=(EVENTS, FUNCTIONS))
    sigma = np.sqrt(2 / EVENTS)
    others = 0.25 * (0.4 * noise + 0.9 * rng.normal(size=noise.shape))
    slope, deviation = (effect + others) / sigma, (noise - data) / sigma
    jacobian = slope.mean(axis=0)
    information = float(jacobian @ jacobian)
    plain = -float(jacobian @ deviation.mean(axis=0)) / information
    deviation += plain * slope
    parts = [x.reshape(PARTS, -1, FUNCTIONS).mean(axis=1) for x in (slope, deviation)]
    move, covariance = of_parts(jacobian[:, np.newaxis], parts[0][:, :, np.newaxis], parts[1])
    return plain, information**-0.5, plain + float(move[0]), float(covariance[0, 0]) ** 0.5


def test_a_fit_without_sampling_noise_has_no_bias_and_errors_that_repeat():
    experiments = [estimate(np.random.default_rng(seed)) for seed in range(200)]
    plain, claimed, fitted, error = np.transpose(experiments)
    pulls = (fitted - TRUE) / error
    assert np.mean((plain - TRUE) / claimed) < -1
    assert abs(pulls.mean()) < 0.25
    assert np.std((fitted - TRUE) / claimed) > 1.3
    assert 0.9 < pulls.std() < 1.2


def test_weights_from_few_pulses_make_errors_larger():
    """A mean weighted by the inverse of a covariance that a few pulses gave."""
    rng, n, d, pulls = np.random.default_rng(1), 100, 40, []
    for _ in range(400):
        weights = np.linalg.inv(np.cov(rng.normal(size=(n, d)).T))
        information = float(weights.sum())
        found = float(weights.sum(axis=0) @ rng.normal(size=d)) / information
        pulls.append(found * information**0.5)
    assert np.var(pulls) > 2
    assert 0.8 < np.var(pulls) / of_weights(n, d, 1) < 1.2


def test_what_pulses_do_not_determine_has_the_error_of_its_prior():
    rng = np.random.default_rng(2)
    slopes = np.zeros((PARTS, FUNCTIONS, 2))
    slopes[:, :, 0] = 1 + 0.1 * rng.normal(size=(PARTS, FUNCTIONS))
    priors = np.diag([1e-3, 1 / 0.7])
    deviations = rng.normal(size=(PARTS, FUNCTIONS))
    jacobian = np.concatenate([slopes.mean(axis=0), priors])
    both = (of_parts(jacobian, slopes, deviations, factor)[1] for factor in (1.0, 1.44))
    errors = [np.sqrt(covariance.diagonal()) for covariance in both]
    np.testing.assert_allclose([one[1] for one in errors], 0.7, rtol=1e-9)
    assert errors[1][0] == pytest.approx(1.2 * errors[0][0], rel=1e-3)
