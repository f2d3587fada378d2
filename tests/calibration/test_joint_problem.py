"""The comparison that chain and physics minimise together, and pulses near simulated ones."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpunet.calibration.identifiability import Linear
from cpunet.calibration.joint_problem import OTHERS, JointProblem, SlicedJoint, first
from cpunet.calibration.nearby import Derivative, Nearby, Simulator, half_maxima, move
from cpunet.calibration.nuisances import Physics, named
from cpunet.networks.response_layer import ElectronicsResponse, deviation_lags
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.training.chain_fit import Fitter, fit_chain, with_decay, with_settings
from cpunet.training.joint import SHRUNK
from cpunet.training.pulse_sets import PulseSets
from synthetic import load_recipe
from unpaired import CHAIN, DT_NS, charge, coarse, faster, measured_with

RECIPE = load_recipe("fast")
FREE = tuple(named(name) for name in ("temperature", "impurity", "self_repulsion"))
PHYSICS = Physics(read_detector("ppc"), SimulationSettings(), FREE[:2])
N = 1200


@pytest.fixture(scope="module")
def sets() -> PulseSets:
    return PulseSets(*measured_with(CHAIN, N), RECIPE, np.random.default_rng(0))


@pytest.fixture(scope="module")
def functions(sets: PulseSets) -> SlicedJoint:
    (sides,) = sets.sides()
    return SlicedJoint(sides)


@pytest.fixture(scope="module")
def nearby() -> Nearby:
    """Two physics: a drift that takes longer, and a wider cloud."""
    fine = charge(N, seed=1)
    base = coarse(fine)
    half = half_maxima(base)
    wider = sum(np.roll(base, shift, axis=1) for shift in (-1, 1)) - 2 * base
    slopes, at = (coarse(faster(fine, 0.9)) - base, wider), np.zeros(2)
    derivatives = {i: Derivative(np.float32(s), at, half) for i, s in enumerate(slopes)}
    return Nearby(SimpleNamespace(physics=PHYSICS), at, base, derivatives)


@pytest.fixture(scope="module")
def start(sets) -> ElectronicsResponse:
    return with_decay(ElectronicsResponse(RECIPE.matching[0], DT_NS), sets.tail_slope)


@pytest.fixture(scope="module")
def fitted(start, functions) -> ElectronicsResponse:
    """The chain fitted to the data with the physics as simulated, which are right."""
    fitter = Fitter(RECIPE.matching.training)
    return fit_chain(copy.deepcopy(start), [functions.sides], fitter).response


@pytest.fixture
def problem(start, functions, nearby):
    def made(*, free=(0, 1), at=(0.0, 0.0), few=False, response=start, **settings):
        some = first([functions], 300) if few else [functions]
        settings |= {"coordinates": np.array(at)}
        return JointProblem(response, nearby, [*free], some, RECIPE, start, **settings)

    return made


def test_chi_square_is_that_of_the_definition(problem, functions):
    both = problem()
    response = both.response
    taken = functions.taking(both.windows(np.zeros(2))[functions.sides.rows])
    transfer = response.transfer(taken.sides.padded)
    noisy = taken.sides.noisy(*taken.sides.translated(transfer))
    simulated = [taken._functions(one) for one in noisy]
    covariance = 0.5 * (np.cov(simulated[0].T) + np.cov(functions.data.T))
    covariance *= 1 / len(taken.sides) + 1 / len(functions.data)
    shrunk = (1 - SHRUNK) * covariance + SHRUNK * np.diag(covariance.diagonal())
    deviation = np.mean(simulated, axis=(0, 1)) - functions.data.mean(axis=0)
    expected = deviation @ np.linalg.solve(shrunk, deviation)
    assert both.compared()[0] == pytest.approx(expected, rel=1e-4)
    pulls = deviation / np.sqrt(covariance.diagonal())
    assert both.compared()[1] == pytest.approx(pulls, abs=1e-3)
    assert both.moments == sum(functions.groups.values()) == len(deviation)


def test_chance_gives_less_than_one_per_function_because_of_the_diagonal():
    covariance = np.array([[4.0, 1.9], [1.9, 1.0]])
    weights = (1 - SHRUNK) * covariance + SHRUNK * np.diag(covariance.diagonal())
    mean, spread = JointProblem.by_chance.fget(SimpleNamespace(weights=[weights]))
    drawn = np.random.default_rng(1).multivariate_normal([0, 0], covariance, 400_000)
    chi_square = (drawn @ np.linalg.inv(weights) * drawn).sum(axis=1)
    assert mean == pytest.approx(chi_square.mean(), rel=0.01)
    assert mean < 1.8
    assert spread == pytest.approx(chi_square.std(), rel=0.01)


def test_far_from_the_data_only_their_covariance_counts(problem, functions):
    (weights,) = problem(held=True).weights
    each = np.cov(functions.data.T) * (1 / len(functions.sides) + 1 / len(functions.data))
    assert np.diag(weights) == pytest.approx(each.diagonal(), rel=1e-6)
    near = problem(weights=[weights])
    assert near.compared()[0] == pytest.approx(problem(held=True).compared()[0])


def test_priors_and_further_knowledge_follow_the_deviations(problem):
    known = problem(knowledge=lambda coordinates: 7 * coordinates[:1])
    vector = known.vector()
    vector[known.n_chain :] = 1.5, 0.02
    found = known.residuals(vector)
    prior = found[known.moments : known.moments + len(vector)]
    assert prior[known.n_chain :] == pytest.approx([1.5 / 3.0, 0.02 / 0.1])
    assert not prior[: known.n_chain].any()
    assert found[-1] == pytest.approx(10.5)
    assert known.coordinates.tolist() == [1.5, 0.02]


def test_what_else_is_known_makes_errors_smaller(problem):
    def linear(one: JointProblem) -> Linear:
        residuals, jacobian, _ = one.both(one.vector())
        halves, widths = np.zeros((2, one.moments)), one.widths
        return Linear(jacobian, residuals, halves, np.zeros(2), widths, 1000.0)

    known = problem(few=True, knowledge=lambda coordinates: 500 * coordinates[1:])
    before, after = linear(problem(few=True)), linear(known)
    own = before.errors([1])[0]
    assert after.errors([1])[0] == pytest.approx((own**-2 + 500**2) ** -0.5, rel=1e-6)
    errors = 3.0, (0.1**-2 + 500**2) ** -0.5
    assert after.errors(pairs=1e-9) == pytest.approx(errors, rel=1e-4)
    np.testing.assert_allclose(after.information(), before.information(), rtol=1e-4)


def test_derivatives_are_those_of_wide_differences(problem, fitted):
    """Noise makes readings of a pulse jump; over wide steps of many that is a motion."""
    both = problem(response=fitted)
    vector = both.vector()
    residuals, jacobian, _ = both.both(vector)
    assert residuals == pytest.approx(both.residuals(vector))
    for i, slope in enumerate(jacobian.T):
        step, ends = 3 / np.linalg.norm(slope), []  # by three standard deviations in all
        for sign in (1, -1):
            there = vector.copy()
            there[i] += sign * step
            ends.append(both.residuals(there))
        wanted = (ends[0] - ends[1]) / (2 * step)
        assert np.linalg.norm(slope - wanted) < 0.2 * np.linalg.norm(wanted)


def test_deviations_of_the_readout_are_free_with_the_physics(problem, fitted):
    """What was added to a right response is taken out again by the modes that it is made of."""
    time_ns = deviation_lags(DT_NS) * DT_NS
    places = np.array([100.0, 400.0])
    modes = 1e-3 * np.exp(-0.5 * ((time_ns[:, np.newaxis] - places) / 60) ** 2)
    other = with_settings(fitted, deviations=True)
    other.deviation[:] = modes @ np.array([2.0, -1.0])
    both = problem(response=other, modes=modes)
    n = both.n_chain
    assert both.vector()[n - 2 : n] == pytest.approx([2.0, -1.0])
    (before, _), end = both.compared(), both.fitted()
    assert before > 1.5 * end.chi_square
    errors = np.sqrt(np.linalg.inv(end.information).diagonal()[n - 2 : n])
    assert np.abs(both.along / errors).max() < 5


def test_the_fit_finds_chain_and_physics(problem, fitted):
    """Both sides have the same physics, and the chain can be described exactly."""
    both = problem(response=fitted, free=[1], at=(0.0, 0.01))
    before, _ = both.compared()
    end = both.fitted()
    assert end.chi_square < 1.2 * both.by_chance[0] + 4 * both.by_chance[1]
    assert before > 2 * end.chi_square
    error = np.sqrt(np.linalg.inv(end.information)[-1, -1])
    assert abs(both.coordinates[1]) < 4 * error


def test_windows_do_not_jump_where_the_alignment_of_pulses_does(problem, nearby):
    """Noise begins with a window, so that a jump by a sample would change it."""
    time = np.arange(1200.0)
    flat = np.linspace(100, 101, 21)[:, np.newaxis]  # samples to the flat top
    base, longer = (np.clip((time - 450) / (flat + x), 0, 1) for x in (0.0, 1.0))
    base, slope = base.astype(np.float32), (longer - base).astype(np.float32)
    centre = np.zeros(2)
    slopes = {0: Derivative(slope, centre, half_maxima(base))}
    one = problem(weights=[np.eye(2)])
    one = replace(one, nearby=Nearby(nearby.simulator, centre, base, slopes))

    def prepared(x):
        at = Pulses.of(one.nearby.at(np.array([x, 0.0])), dt_ns=16)
        return prepare(at, RECIPE.preparation, "simulated")

    here, one_more = (one.windows(np.array([x, 0.0])) for x in (0.0, 1.0))
    assert here == pytest.approx(prepared(0.0).pulses.waveforms, abs=1e-6)
    for x in (-0.02, 0.02, 0.3):
        there = one.windows(np.array([x, 0.0]))
        # a jump by a sample is 0.01; the scale to a highest value of 1 changes by 1e-4
        assert there == pytest.approx(here + x * (one_more - here), abs=2e-4)
    assert (prepared(0.3).align_sample != prepared(0.0).align_sample).any()


def values_of(functions, group):
    """Values of the functions of a group, for the measured pulses."""
    names, numbers = [*functions.groups], [*functions.groups.values()]
    end = sum(numbers[: names.index(group) + 1])
    return functions.data[:, end - functions.groups[group] : end]


def test_slices_multiply_components_and_amplitudes(functions):
    """All slices are numbers of the drift time times what is sliced."""
    second, third = values_of(functions, "components")[:, [-2, -3]].T
    slices = values_of(functions, "components in slices").reshape(len(second), OTHERS, -1)
    both = slices[:, 0] * third[:, None], slices[:, 1] * second[:, None]
    np.testing.assert_allclose(*both, atol=1e-9)
    some = np.abs(second) > 0.1
    shares = slices[some, 0] / second[some, None]
    amplitude = values_of(functions, "current amplitude in slices")
    amplitude = amplitude.reshape(len(second), -1, shares.shape[1])[some, 2]
    k = shares.argmax(axis=1)[:, None]
    bins = np.take_along_axis(amplitude / shares.clip(1e-12), k, 1)
    np.testing.assert_allclose(amplitude, bins * shares, atol=1e-9)
    assert bins.min() >= 0
    assert bins.max() <= 1


def test_wider_functions_see_pulses_far_from_the_data(functions):
    """Narrow bins would all be empty, and have no derivatives."""
    sides, wide = functions.sides, SlicedJoint(functions.sides, 16.0)
    shape = functions._shape(sides.data)
    shape[:, -1] = 10.0  # drift times in their robust standard deviations
    near, far = (one._sliced(shape, sides.data)[0][0] for one in (functions, wide))
    assert near.max() < 1e-6
    assert far.max() > 1e-2


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    detector = read_detector("ppc", ["grid_mm=0.5"])
    rng = np.random.default_rng(2)
    place = rng.uniform([-12, -12, 5], [12, 12, 30], (30, 3))
    hits = Hits.of(place, rng.uniform(200, 1000, 30), np.arange(0, 31, 3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CPUNET_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield Simulator(hits, Physics(detector, SimulationSettings(dt_ns=4), FREE))


def laid_over(pulses, others):
    """Pulses moved so that they pass half of their height where the others do."""
    at, there = (half_maxima(some) for some in (pulses, others))
    return move(pulses, at - there)


def test_small_changes_are_those_of_a_simulation(simulator):
    at = np.zeros(3)
    nearby = Nearby(simulator, at, simulator(at)).again(range(3))
    there = np.array([0.4, -0.008, 0.3])
    exact = simulator(there)
    near = nearby.at(there)
    change = laid_over(exact, nearby.base) - nearby.base
    left = laid_over(near, nearby.base) - laid_over(exact, nearby.base)
    assert np.sqrt((left**2).mean()) < 0.25 * np.sqrt((change**2).mean())


def test_derivatives_follow_the_edge(simulator):
    """Edges of a warmer detector are later, and self-repulsion smears them there."""
    warmer = np.array([0.5, 0.0, 0.0])
    before, fresh = (
        Nearby(simulator, at, simulator(at)).again([2]) for at in (0 * warmer, warmer)
    )
    nearby = replace(fresh, derivatives=before.derivatives)
    late = nearby.half - nearby.derivatives[2].half
    assert late.max() > 0.3  # samples
    far = np.argmax(late)
    both = nearby.slopes[2], nearby.derivatives[2].pulses
    followed, stale = (np.linalg.norm(of[far] - fresh.slopes[2][far]) for of in both)
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
