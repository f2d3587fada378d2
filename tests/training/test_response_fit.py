"""Responses fitted to unpaired pulses that went through a chain of known numbers."""

from __future__ import annotations

import copy
import dataclasses
from typing import NamedTuple

import numpy as np
import pytest
import scipy.fft

from cpunet.electronics.chain import Electronics
from cpunet.networks.response_layer import ElectronicsResponse, record_length
from cpunet.pulses.container import Pulses
from cpunet.training import response_starts
from cpunet.training.fitter import GOOD_FIT, Fitted, Fitter
from cpunet.training.moments import Moments, Readings
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_fit import Fit, fit_response
from cpunet.training.response_problem import STRETCH, Band, ResponseProblem
from cpunet.training.response_starts import drift_if_needed, with_settings
from cpunet.training.translated import Noise, SimulatedSide
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

STARTS = ["near", pytest.param("far", marks=pytest.mark.slow)]
FEW = ("generator.slow_ns=[400]", "generator.fast_decays_us=[]")
RECIPE = load_recipe("fast", FEW)


class Told(NamedTuple):
    response: ElectronicsResponse
    fit: Fit
    steps: list[tuple[int, float]]


class Problem(Unpaired):
    """Unpaired sets that a chain of few parameters is fitted to."""

    def fit(self, seed: int, *overrides: str, sim: Pulses | None = None) -> Told:
        recipe, rng = load_recipe("fast", [*FEW, *overrides]), np.random.default_rng(seed)
        sides, steps = (self.sim if sim is None else sim, self.data), []
        fitter = Fitter(
            recipe.matching.training, listener=lambda *step: steps.append(step), seed=seed
        )
        sets = PulseSets(*sides, self.noise, recipe, rng)
        return Told(*fit_response(sets, fitter), steps)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return Problem(*measured_with(CHAIN))


@pytest.fixture(scope="module")
def near(problem: Problem) -> Told:
    return problem.fit(0)


@pytest.fixture(scope="module")
def far(problem: Problem) -> Told:
    """Other noise, and a start with three times the bandwidth that there is."""
    return problem.fit(1, "generator.poles_ns=[20, 10]")


def rise_ns(step: np.ndarray) -> float:
    """From 10 to 90 % of the highest, for a step sampled every ns."""
    step = step[: int(step.argmax())] / step.max()
    early, late = np.interp([0.1, 0.9], step, np.arange(len(step)))
    return float(late - early)


def learned_rise_ns(response: ElectronicsResponse) -> float:
    fine = copy.deepcopy(response)
    fine.dt_ns.fill(1.0)
    return rise_ns(scipy.fft.irfft(fine.transfer(16_384), 16_384)[:4000])


@pytest.mark.parametrize("which", STARTS)
def test_the_chain_is_found(request, which: str) -> None:
    found: Told = request.getfixturevalue(which)
    true_rise = rise_ns(CHAIN.transfer.step(np.arange(4000.0)))
    assert learned_rise_ns(found.response) == pytest.approx(true_rise, rel=0.02)
    numbers = found.response.describe()
    assert numbers["decay_us"] == pytest.approx(80, rel=0.01)
    assert numbers["slow_400_ns"] == pytest.approx(0.065, rel=0.05)
    assert found.fit.chi_square < 1.6 * found.fit.moments


@pytest.mark.parametrize("which", STARTS)
def test_the_errors_cover_the_truth(request, which: str) -> None:
    found: Told = request.getfixturevalue(which)
    numbers, errors = found.response.describe(), found.fit.errors
    # which of the two poles is the longer is a matter of the start
    poles = np.sort(found.response.log_poles_ns)
    pole_errors = sorted((errors["log_poles_ns.1"], errors["log_poles_ns.2"]), reverse=True)
    assert (np.abs(poles - np.log([35, 55])) < 4 * np.array(pole_errors)).all()
    assert abs(numbers["slow_400_ns"] - 0.065) < 4 * errors["slow_weights.1"]
    # noise slower than a record is shared by pulses of one trace, which errors do not know
    assert abs(np.log(numbers["decay_us"] / 80)) < 8 * errors["log_decay_us.1"]
    # and they are no excuse: the set fixes each within a few percent
    assert max(pole_errors) < 0.1
    assert errors["slow_weights.1"] < 0.002


def test_edges_are_those_of_the_true_chain(near: Told) -> None:
    errors = edge_errors(near.response)
    assert np.median(errors) < 1e-3
    assert np.quantile(errors, 0.95) < 5e-3


def test_what_a_fit_tells(near: Told) -> None:
    steps, chi_square = zip(*near.steps, strict=True)
    assert steps == tuple(range(1, near.fit.steps + 1))
    assert chi_square[-1] == pytest.approx(near.fit.chi_square)
    assert chi_square[-1] < near.fit.moments < chi_square[0]
    assert len(near.fit.pulls) == near.fit.moments
    labels = {"log_poles_ns.1", "log_poles_ns.2", "log_decay_us.1", "slow_weights.1"}
    assert set(near.fit.errors) == labels
    # of a good fit they are as standard deviations: a few are 2, hardly one is 4
    pulls = np.abs(list(near.fit.pulls.values()))
    assert np.sqrt((pulls**2).mean()) < 1.6
    assert pulls.max() < 5


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_fit(problem: Problem) -> None:
    short = ("training.steps=1", "training.search_pulses=250", "training.start_factors=[1]")
    short += ("training.ringing_mhz=[]",)
    few = Problem(problem.sim[:250], problem.data[:250], problem.noise)
    first, again, other = (few.fit(seed, *short) for seed in (5, 5, 6))
    assert first[0].describe() == again[0].describe()
    assert first[1] == again[1]
    assert first[0].describe() != other[0].describe()


DRIFT = ("training.drift_terms=2", "training.start_factors=[1]", "training.ringing_mhz=[]")


@pytest.mark.thorough
def test_a_drift_simulated_too_short_is_stretched(problem: Problem) -> None:
    """The readout is then the true one, and not what makes up for the drift."""
    short = simulated(faster(charge(N, seed=1), 1.25))
    response, fit, steps = problem.fit(0, *DRIFT, sim=short)
    assert fit.chi_square < GOOD_FIT * fit.moments
    assert fit.steps == len(steps)  # those of all fits
    numbers = response.describe()
    error = fit.errors["drift.stretch.1"]
    assert error < 0.03
    assert abs(numbers["drift_stretch"] - 0.25) < 4 * error
    true_rise = rise_ns(CHAIN.transfer.step(np.arange(4000.0)))
    assert learned_rise_ns(response) == pytest.approx(true_rise, rel=0.02)
    assert numbers["slow_400_ns"] == pytest.approx(0.065, rel=0.1)

    alone, poor, _ = problem.fit(0, "training.drift_terms=0", *DRIFT[1:], sim=short)
    assert alone.drift is None
    assert not poor.checks.good
    assert "onset" in poor.checks.off


@pytest.mark.thorough
def test_a_drift_of_another_detector_is_not_stretched(problem: Problem, monkeypatch) -> None:
    monkeypatch.setattr(response_starts, "MAX_STRETCH", 0.05)
    short = simulated(faster(charge(N, seed=1), 1.25))
    response, fit, _ = problem.fit(0, *DRIFT, sim=short)
    assert response.drift is None
    assert not fit.checks.good


@pytest.mark.thorough
def test_a_drift_as_simulated_is_not_stretched(problem: Problem, near: Told) -> None:
    response, fit, _ = problem.fit(0, "training.drift_terms=2")
    assert response.drift is None
    assert fit == near.fit


@pytest.mark.slow
def test_a_ringing_is_found_with_few_pulses() -> None:
    ringing = {"frequency_MHz": 5.0, "fraction": 0.285, "damping_ns": 160.0}
    rings = measured_with(Electronics.model_validate(CHAIN.model_dump() | {"ringing": ringing}))
    few = Problem(rings.sim[:300], rings.data[:250], rings.noise)
    response, fit, _ = few.fit(0, "training.start_factors=[1]")
    assert response.config.deviations
    assert fit.checks.good


@pytest.fixture(scope="module")
def asked(problem: Problem) -> ResponseProblem:
    """A small comparison, where the response's start is."""
    recipe = load_recipe("fast", FEW)
    generator, training = recipe.matching
    few = problem.sim[:64]
    length = record_length(few.waveforms.shape[1], few.dt_ns)
    drawn = Noise.draw(problem.noise, few.energy_kev, length, 2, np.random.default_rng(0))
    moments = Moments.of_data(problem.data.waveforms, training, recipe.preparation)
    band = Band("all", SimulatedSide(few.waveforms, drawn, moments, np.ones(64)), np.arange(64))
    return ResponseProblem(ElectronicsResponse(generator, DT_NS), [band])


def test_records_are_stretched_as_the_layer_stretches(asked: ResponseProblem) -> None:
    """And what is kept of one stretch is not used for the next."""
    more = asked.of(with_settings(asked.response, drift_terms=1))
    vector = more.parameters.vector()
    as_simulated, plain = more.pulls(vector), asked.pulls(asked.parameters.vector())
    np.testing.assert_allclose(as_simulated, plain, atol=1e-3)
    vector[more.parameters.labels.index(STRETCH)] = 0.1
    found = more.pulls(vector)
    band = asked.bands[0]
    longer = more.response.drifted(band.sim.sim)
    by_hand = Band(band.name, dataclasses.replace(band.sim, sim=longer), band.rows)
    expected = asked.of(asked.response, [by_hand]).pulls(asked.parameters.vector())
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert np.abs(found - plain).max() > 1


def test_a_needless_stretch_is_taken_out(asked: ResponseProblem) -> None:
    """It may have stood in for a ringing that was found later."""
    stretched = asked.of(with_settings(asked.response, drift_terms=1))
    vector = stretched.parameters.vector()
    vector[stretched.parameters.labels.index(STRETCH)] = 0.002
    stretched.parameters.set(vector)
    residuals = stretched.residuals(vector)

    def known_to(error: float) -> Fitted:
        cost = float(residuals @ residuals)
        found = Fitted(stretched, cost, np.eye(len(vector)) * error**2)
        return drift_if_needed(found, Fitter(RECIPE.training))

    assert known_to(0.001).problem.response.drift is None
    assert known_to(0.0005).problem is stretched
    simulated = Fitted(asked, 1.0, np.eye(len(vector) - 1))
    assert drift_if_needed(simulated, Fitter(RECIPE.training)) is simulated


@pytest.mark.parametrize(("beyond", "share"), [(0.19, 0.81), (0.21, 1.0)])
def test_blocks_do_not_decide_which_tails_are_excluded(
    asked: ResponseProblem, beyond: float, share: float
) -> None:
    sim, slopes = asked.bands[0].sim, list[float]()
    sim.sums(
        asked.response,
        lambda r: (slopes.extend(r.linear[:, -1]), (np.zeros(1),))[1],
        cut=False,
        draws=1,
    )
    moments = sim.moments
    low = np.quantile(slopes, beyond) * moments.spreads[-1] + moments.centres[-1]
    moments = dataclasses.replace(moments, slope_range=(low, np.inf))
    some = dataclasses.replace(sim, moments=moments)

    def of(readings: Readings) -> tuple[np.ndarray]:
        return (readings.weights @ readings.linear,)

    found = [
        some.sums_of_blocks(asked.response, of, size=size, draws=1) for size in (7, 64, 512)
    ]
    totals = [sum(total for (total,), _ in blocks) for blocks in found]
    used = [sum(n for _, n in blocks) for blocks in found]
    assert used == [used[0]] * 3
    assert used[0] / len(sim) == pytest.approx(share, abs=0.005)
    for total in totals[1:]:
        np.testing.assert_allclose(total, totals[0], rtol=1e-4, atol=1e-4 * used[0])


def test_no_ringing_is_found_where_there_is_none(near: Told) -> None:
    assert "ringing_mhz" not in near.response.describe()
