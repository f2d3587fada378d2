"""Responses fitted to unpaired pulses that went through a known chain; their coordinates."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import scipy.fft

from cpunet.electronics.chain import Electronics
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.training import response_fit
from cpunet.training.chain_fit import (
    POOR,
    STRETCH,
    WIDE,
    Fitter,
    Parabola,
    SmoothParameters,
    chi_square,
    differences,
    fit_chain,
    minimum,
    vector_of,
    with_decay,
)
from cpunet.training.comparison import Difference
from cpunet.training.joint import SEGMENTS, Joint, SingleSites
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_fit import fit_response
from cpunet.training.verdict import FitInfo, amplitude_shift
from synthetic import load_recipe
from unpaired import (
    CHAIN,
    DT_NS,
    N,
    Unpaired,
    charge,
    edge_errors,
    faster,
    measured_with,
    simulated,
)

STEP = 0.02  # in widths of the priors
FEW = ("generator.slow_ns=[400]", "generator.fast_decays_us=[]")
RECIPE = load_recipe("fast", FEW)
DRIFT = ("training.drift_terms=2", "training.start_factors=[1]")


class Told(NamedTuple):
    response: ElectronicsResponse
    fit: FitInfo
    steps: list[tuple[int, float]]


class Problem(Unpaired):
    """Unpaired sets that a chain of few parameters is fitted to."""

    def fit(self, seed: int, *overrides: str, sim: Pulses | None = None) -> Told:
        recipe, rng = load_recipe("fast", [*FEW, *overrides]), np.random.default_rng(seed)
        sides, steps = (self.sim if sim is None else sim, self.data), []
        fitter = Fitter(recipe.matching.training, listener=lambda *step: steps.append(step))
        sets = PulseSets(*sides, self.noise, recipe, rng)
        return Told(*fit_response(sets, fitter), steps)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return Problem(*measured_with(CHAIN))


@pytest.fixture(scope="module")
def near(problem: Problem) -> Told:
    return problem.fit(0)


def rise_ns(step: np.ndarray) -> float:
    """From 10 to 90 % of the highest, for a step sampled every ns."""
    step = step[: int(step.argmax())] / step.max()
    early, late = np.interp([0.1, 0.9], step, np.arange(len(step)))
    return float(late - early)


def learned_rise_ns(response: ElectronicsResponse) -> float:
    fine = copy.deepcopy(response)
    fine.dt_ns.fill(1.0)
    return rise_ns(scipy.fft.irfft(fine.transfer(16_384), 16_384)[:4000])


def test_the_chain_is_found_and_errors_cover_the_truth(near: Told) -> None:
    response, numbers, errors = near.response, near.response.describe(), near.fit.errors
    true_rise = rise_ns(CHAIN.transfer.step(np.arange(4000.0)))
    assert learned_rise_ns(response) == pytest.approx(true_rise, rel=0.02)
    assert numbers["decay_us"] == pytest.approx(80, rel=0.01)
    of_edges = edge_errors(response)
    assert np.median(of_edges) < 1e-3
    assert np.quantile(of_edges, 0.95) < 5e-3
    # which of the two poles is the longer is a matter of the start
    poles = np.sort(response.log_poles_ns)
    pole_errors = sorted((errors["log_poles_ns.1"], errors["log_poles_ns.2"]), reverse=True)
    assert (np.abs(poles - np.log([35, 55])) < 4 * np.array(pole_errors)).all()
    assert abs(numbers["slow_400_ns"] - 0.065) < 4 * errors["slow_weights.1"]
    # noise slower than a record is shared by pulses of one trace, which errors do not know
    assert abs(np.log(numbers["decay_us"] / 80)) < 8 * errors["log_decay_us.1"]
    # and they are no excuse: the set fixes each within a few percent
    assert max(pole_errors) < 0.1
    assert errors["slow_weights.1"] < 0.002
    # what the fit says
    steps, chi_square = zip(*near.steps, strict=True)
    assert steps == tuple(range(1, near.fit.steps + 1))
    assert chi_square[-1] == pytest.approx(near.fit.chi_square)
    assert chi_square[-1] < 1.1 * near.fit.moments
    labels = {"log_poles_ns.1", "log_poles_ns.2", "log_decay_us.1", "slow_weights.1"}
    assert set(near.fit.errors) == labels | {"sharpness.1"}
    assert near.response.drift is None
    # those of the mean pulse are as standard deviations: a few are 2, hardly one is 4
    pulls = np.abs(list(near.fit.pulls.values()))
    assert np.sqrt((pulls**2).mean()) < 1.6
    assert pulls.max() < 5


@pytest.mark.thorough
def test_a_drift_simulated_too_short_is_stretched(problem: Problem, monkeypatch) -> None:
    """The readout is then the true one, and not what makes up for the drift."""
    short = simulated(faster(charge(N, seed=1), 1.25))
    response, fit, steps = problem.fit(0, *DRIFT, sim=short)
    assert fit.chi_square < POOR * fit.moments
    assert fit.steps == len(steps)  # those of all fits
    numbers = response.describe()
    error = fit.errors["drift.stretch.1"]
    assert error < 0.03
    assert abs(numbers["drift_stretch"] - 0.25) < 4 * error
    true_rise = rise_ns(CHAIN.transfer.step(np.arange(4000.0)))
    assert learned_rise_ns(response) == pytest.approx(true_rise, rel=0.02)
    assert numbers["slow_400_ns"] == pytest.approx(0.065, rel=0.1)

    # nor is that of another detector stretched
    monkeypatch.setattr(response_fit, "MAX_STRETCH", 0.05)
    alone, poor, _ = problem.fit(0, *DRIFT, sim=short)
    assert alone.drift is None
    assert not poor.checks.good
    assert "onset" in poor.checks.off


def test_pulses_that_cuts_of_the_data_take_for_piled_up_are_compared_on_neither_side(
    problem: Problem, near: Told
) -> None:
    """A tenth of the charge is collected 2 µs late in some, as near a weak field."""
    rows, late = np.arange(0, N, 20), round(2000 / DT_NS)
    waveforms = problem.sim.waveforms.copy()
    waveforms[rows, late:] -= 0.1 * (waveforms[rows, late:] - waveforms[rows, :-late])
    sim = problem.sim.with_waveforms(waveforms)
    (sides,) = PulseSets(sim, *problem[1:3], RECIPE, np.random.default_rng(0)).sides()
    cut = sides.cut_like_data(near.response)
    left = set(range(N)) - set(cut.rows.tolist())
    assert cut.sim_left_out == len(left)
    assert {*rows.tolist()} <= left
    assert abs(len(left) - len(rows) - sides.left_out) < 3 * (2 * sides.left_out) ** 0.5


@pytest.mark.thorough
def test_a_ringing_is_found_with_few_pulses() -> None:
    ringing = {"frequency_MHz": 5.0, "fraction": 0.285, "damping_ns": 160.0}
    rings = measured_with(Electronics.model_validate(CHAIN.model_dump() | {"ringing": ringing}))
    few = Problem(rings.sim[:300], rings.data[:250], rings.noise)
    response, fit, _ = few.fit(0, "training.start_factors=[1]")
    assert response.config.deviations
    assert fit.checks.good


def test_derivatives_of_a_fit_are_those_of_differences(problem: Problem) -> None:
    """With little noise, by which pulses go from bin to bin; those of a stretch included."""
    generator, _ = RECIPE.matching
    config = generator.model_copy(update={"poles_ns": (55.0, 35.0), "drift_terms": 1})
    start = ElectronicsResponse(config.model_copy(update={"decay_us": 80.0}), DT_NS)
    (sides,) = PulseSets(*problem[:3], RECIPE, np.random.default_rng(0)).sides()
    sides.noise.factor = 1e-3 * sides.noise.factor
    parameters = SmoothParameters(start)
    place, compared = parameters.vector(), Joint(sides)
    here = differences(parameters, compared)
    for i, width in enumerate(parameters.widths):
        ends = []
        for sign in (1, -1):
            parameters.set(place + sign * STEP * width * np.eye(len(place))[i])
            ends.append(differences(parameters, compared).values)
        parameters.set(place)
        wanted = (ends[0] - ends[1]) / (2 * STEP * width)
        error = here.covariance.diagonal() ** 0.5
        # Levels follow half heights by whole samples, so that a difference of a shift counts
        # the pulses that pass one; the derivative has their mean, and tails are not compared.
        shifts = parameters.labels[i] in (STRETCH, "log_poles_ns")
        some = slice(SEGMENTS if shifts else 0, None)
        off = np.linalg.norm(((here.slopes[:, i] - wanted) / error)[some])
        assert off < 0.15 * np.linalg.norm((wanted / error)[some]), parameters.labels[i]


def test_derivatives_of_the_same_pulses_do_not_pull_a_fit() -> None:
    """Derivatives that go with functions, of equal sides: on average no gradient is left."""
    rng, n, experiments = np.random.default_rng(1), 200, 300
    functions, covariance = 30, 2 / n * np.eye(30)
    gradients, shared = [], []
    for _ in range(experiments):
        each, data = rng.standard_normal((2, n, functions))
        slopes = (0.5 * each + rng.standard_normal((n, functions)))[..., np.newaxis]
        off = each.mean(axis=0) - data.mean(axis=0)
        of_parts, values = (
            of.reshape(20, n // 20, *of.shape[1:]).mean(axis=1) for of in (slopes, each)
        )
        same = Difference(off, covariance, slopes.mean(axis=0), (of_parts, values))
        gradients.append(same.slopes[:, 0] @ np.linalg.solve(covariance, off))
        shared.append(same.shared[0])
    error = np.std(gradients) / experiments**0.5
    assert np.mean(gradients) == pytest.approx(functions * 0.5 / 2, abs=4 * error)
    assert np.mean(gradients) > 20 * error
    assert np.mean(gradients) - np.mean(shared) == pytest.approx(0, abs=4 * error)


def test_a_known_response_is_where_a_fit_starts(problem: Problem, near: Told) -> None:
    """It is left as it is, and what is found does not depend on it."""
    recipe, known = RECIPE, copy.deepcopy(near.response)
    known.log_decay_us.fill(np.log(300.0))
    fitter, rng = Fitter(recipe.matching.training), np.random.default_rng(0)
    sets = PulseSets(problem.sim, problem.data, problem.noise, recipe, rng)
    found, fit = fit_response(sets, fitter, known)
    assert np.exp(known.log_decay_us[0]) == pytest.approx(300.0)
    assert found.describe()["decay_us"] == pytest.approx(80, rel=0.01)
    assert fit.steps < near.fit.steps


def test_where_no_chain_is_near_a_fit_leads_no_farther_away(problem: Problem) -> None:
    """Behind a wave of 1 MHz the joint comparison saturates, and its minimum is anywhere."""
    time_ns = DT_NS * (np.arange(problem.data.waveforms.shape[1]) - 400)
    wave = np.where((time_ns > 0) & (time_ns < 3000), np.sin(2e-3 * np.pi * time_ns), 0)
    waveforms = problem.data.waveforms + np.float32(0.02) * wave.astype(np.float32)
    both = problem.sim, problem.data.with_waveforms(waveforms)
    sets = PulseSets(*both, problem.noise, RECIPE, np.random.default_rng(0))
    bands, start = sets.sides(), ElectronicsResponse(RECIPE.matching[0], DT_NS)
    with_decay(start, sets.tail_slope)
    before, _ = chi_square(start, bands, WIDE)
    assert fit_chain(start, bands, Fitter(RECIPE.matching.training)).poor
    assert chi_square(start, bands, WIDE)[0] < 1.01 * before


def test_the_peak_of_single_sites_does_not_depend_on_the_mixture() -> None:
    """Twice as many other pulses do not matter, another amplitude does."""
    rng = np.random.default_rng(0)

    def set_of(many: int, shift: float = 0.0) -> SimpleNamespace:
        single, others = rng.normal(shift, 0.005, 20_000), rng.uniform(-1.0, -0.05, many)
        return SimpleNamespace(log_amplitude=np.concatenate([single, others]))

    peak = SingleSites(SimpleNamespace(data=set_of(10_000)))
    assert peak.places[6] == pytest.approx(0.0, abs=0.005)
    np.testing.assert_allclose(peak.data.mean(axis=0), 0, atol=1e-12)
    errors = peak.data.std(axis=0) / np.sqrt(20_000)
    same, moved = (peak._functions(set_of(40_000, s)).mean(axis=0) for s in (0.0, 0.002))
    assert np.abs(same / errors).max() < 5
    assert np.abs(moved / errors).max() > 20


@pytest.mark.parametrize("shift", [0.0, 0.002, -0.05])
def test_the_shift_of_amplitudes_is_told(shift: float) -> None:
    covariance = 1e-6 * (np.eye(16) + 0.5)
    quantiles = Difference(np.full(16, -shift), covariance)
    found, error = amplitude_shift([quantiles])
    assert found == pytest.approx(shift)
    assert error == pytest.approx((1e-6 * (1 / 16 + 0.5)) ** 0.5)


def chain_of(poles_ns: tuple[float, float], slow: float) -> ElectronicsResponse:
    few = ["generator.slow_ns=[400]", "generator.fast_decays_us=[4, 16]"]
    made = ElectronicsResponse(load_recipe("fast", few).matching[0], DT_NS)
    made.log_poles_ns[...] = np.log(poles_ns)
    made.log_decay_us.fill(float(np.log(80.0)))
    made.slow_weights.fill(slow)
    return made


def put(response: ElectronicsResponse, vector: np.ndarray) -> None:
    """Set the parameters themselves."""
    parts = [*response.parameters.values()]
    stops = np.cumsum([len(part) for part in parts])[:-1]
    for part, values in zip(parts, np.split(vector, stops), strict=True):
        part[:] = values


def test_coordinates_are_those_of_poles_and_decays_and_back() -> None:
    made = chain_of((60.0, 40.0), 0.05)
    smooth = SmoothParameters(made)
    decay, vector = smooth.labels.index("log_decay_us"), vector_of(made)
    vector[decay] += np.log(0.8)
    vector[-2:] = 0.05, -0.02
    put(made, vector)
    place = smooth.vector()
    np.testing.assert_allclose(place[0], np.log(2400) / 2)
    np.testing.assert_allclose(place[1], (np.log(1.5) / 2) ** 2)
    assert place[decay] == pytest.approx(0.97 * 0.25)
    smooth.set(place - np.eye(len(place))[1])  # below 0 there are no real poles
    np.testing.assert_allclose(np.exp(made.log_poles_ns), 2400**0.5)
    smooth.set(place)
    np.testing.assert_allclose(vector_of(made), vector, rtol=1e-12)
    # derivatives of the coordinates with the parameters
    slopes = []
    for step in 1e-6 * np.eye(len(vector)):
        put(made, vector + step)
        slopes.append((smooth.vector() - place) / 1e-6)
    put(made, vector)
    np.testing.assert_allclose(smooth.turn().T, slopes, atol=1e-5)
    known = np.diag([1e4, 1e6, 1e4, 1e6, 1e2, 1e5, 1e5])
    by_parameters = np.array(slopes) @ known @ np.transpose(slopes)
    priors = np.diag(SmoothParameters(made, poles=False).widths ** -2.0)
    covariance = np.linalg.inv(by_parameters + priors)
    np.testing.assert_allclose(smooth.covariance(known), covariance, rtol=1e-4, atol=1e-9)


def test_samples_are_no_sharper_than_points_and_no_blunter_than_means() -> None:
    """A step that leads beyond ends at the bound, and the other coordinates make up for it."""
    unknowns = SmoothParameters(chain_of((60.0, 40.0), 0.05))
    at = unknowns.labels.index("sharpness")
    truth = unknowns.vector() + np.eye(len(unknowns.centre))[at]  # 1.5
    rows = 100 * (np.eye(len(truth)) + 0.3)

    def parabola(place: np.ndarray) -> Parabola:
        off = (place - unknowns.centre) / unknowns.widths
        deviation = rows @ (place - truth)
        gradient = rows.T @ deviation + off / unknowns.widths
        cost = float(deviation @ deviation)
        return Parabola(place, cost, 1, rows.T @ rows, cost + float(off @ off), gradient)

    end = minimum(unknowns, parabola, 20, 1e-9, lambda _: None)
    assert end.place[at] == 1.0
    assert abs(parabola(end.place).gradient[np.arange(len(truth)) != at]).max() < 1e-6
