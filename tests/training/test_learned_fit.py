"""The recipe cpunet: exact derivatives, a response from unpaired pulses, and its U-Net."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cpunet.networks.learned_response import StepResponse
from cpunet.recipes.schema import Recipe
from cpunet.training import fitter
from cpunet.training.differentiable import DifferentiableSet
from cpunet.training.dual_numbers import Dual
from cpunet.training.fitter import Fitter
from cpunet.training.learned_fit import UNET, fit_learned
from cpunet.training.moments import Readings
from cpunet.training.optimal_weights import ConditionalFunctions
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_problem import Band, Parameters, ResponseProblem
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

RECIPE = load_recipe("cpunet", ["training.noise_sets=2"])
DECAY_US = CHAIN.decays[0].tau_us


@pytest.fixture(scope="module")
def problem() -> Unpaired:
    return measured_with(CHAIN)


@pytest.fixture(scope="module")
def band(problem: Unpaired) -> Band:
    rng = np.random.default_rng(0)
    sets = PulseSets(problem.sim, problem.data, problem.noise, RECIPE, rng)
    (band,) = sets.bands(400)
    return band


def near() -> StepResponse:
    response = StepResponse(RECIPE.generator, DT_NS)
    response.set_base(48.0, -DT_NS * 1e-3 / DECAY_US)
    return response


def test_functions_are_those_of_the_moments(band):
    response = near()
    ways = Parameters(response).ways(band.sim)
    values = DifferentiableSet(band.sim).blocks(
        ways, band.moments.functions, lambda first, values, moved, weights: values
    )
    mean = torch.cat(values).mean(dim=0).numpy()
    each = band.sim.of_each(response, band.moments.functions)
    np.testing.assert_allclose(mean, each.mean(axis=0), atol=2e-3)
    (total,), n = band.sim.sums(
        response, lambda r: (r.weights @ band.moments.functions(r),), cut=False
    )
    spread = band.moments.values.std(axis=0)
    np.testing.assert_allclose(mean / spread, total / n / spread, atol=2e-3)


def test_functions_of_readings_with_derivatives(band):
    """They are those of arrays, and change with these as differences say."""
    functions = ConditionalFunctions.of(band.moments, 16)
    data, step = band.moments.data[:50], 1e-4
    np.testing.assert_allclose(functions.sum(data), functions(data).sum(axis=0))
    ways = np.random.default_rng(0).normal(size=(3, 50, data.linear.shape[1] + 1))
    linear, amplitude = (
        Dual(torch.from_numpy(x), torch.from_numpy(slopes))
        for x, slopes in (
            (data.linear, ways[..., :-1]),
            (data.log_amplitude, 0.01 * ways[..., -1]),
        )
    )
    found = functions(Readings(linear, amplitude, data.weights))
    np.testing.assert_allclose(found.value, functions(data), atol=1e-12)
    for way, slope in zip(ways, found.slopes, strict=True):
        moved = [
            functions(
                Readings(
                    data.linear + sign * step * way[:, :-1],
                    data.log_amplitude + sign * step * 0.01 * way[:, -1],
                    data.weights,
                )
            )
            for sign in (1, -1)
        ]
        wanted = (moved[0] - moved[1]) / (2 * step)
        np.testing.assert_allclose(slope, wanted, atol=1e-4 * abs(wanted).max())


@pytest.mark.parametrize("number", [0, 4, 10, 20])
def test_derivatives_are_those_of_wide_differences(band, number):
    """Of the compiled readings, whose windows jump: over a wide step, jumps are a motion."""
    response = near()
    compared = ResponseProblem(response, [band])
    compared.clip = 16.0
    start, step = np.zeros(len(response.coordinates)), 0.1
    slopes = compared.derivatives(start)
    sides = []
    for sign in (1, -1):
        moved = start.copy()
        moved[number] = sign * step
        sides.append(compared.deviations(moved))
    wanted = (sides[0] - sides[1]) / (2 * step)
    assert np.linalg.norm(slopes[:, number] - wanted) < 0.1 * np.linalg.norm(wanted)


def learned(problem: Unpaired, recipe: Recipe = RECIPE):
    sets = PulseSets(*problem, recipe, np.random.default_rng(0))
    return fit_learned(sets, Fitter(recipe.matching.training))


@pytest.fixture(scope="module")
def fitted(problem: Unpaired):
    return learned(problem)


@pytest.mark.thorough
def test_pulses_are_those_of_the_true_chain(problem, fitted):
    """From unpaired pulses: others, which were not in the fit, have the shape of the truth."""
    response, fit = fitted
    assert fit.chi_square / fit.moments < 1.6
    assert fit.gains == {}
    errors = edge_errors(response)
    assert np.median(errors) < 1e-3
    assert np.quantile(errors, 0.95) < 2e-3


@pytest.mark.thorough
def test_the_unet_makes_up_for_a_drift_simulated_too_short(monkeypatch):
    """Charge then arrives over longer times, and held-out pulses are closer to the data."""
    monkeypatch.setattr(fitter, "SURE", 0.0)  # of so few pulses two errors are much
    true = measured_with(CHAIN)
    short = simulated(faster(charge(N, seed=1), 1.25))
    response, fit = learned(true._replace(sim=short))
    assert "% of it kept; chi-square of held-out pulses" in fit.gains[UNET]
    assert response.config.drift
    _, longer, _ = response.drift.effect(torch.from_numpy(short.waveforms))
    assert longer.mean() > 0.02
    alone = load_recipe("cpunet", ["training.noise_sets=2", "training.drift_terms=0"])
    _, fit = learned(true._replace(sim=short), alone)
    assert fit.gains == {}
