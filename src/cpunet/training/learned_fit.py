"""Fit the learned readout and the U-Net before it to unpaired pulses: the recipe ``cpunet``.

1. A linear discriminator, solved: the moments that separate the two sides best are those of
   `cpunet.training.moments`; the step response moves until they agree (Gauss-Newton with exact
   derivatives).  Far from the data, narrow bins of the current amplitude are blind, so the
   first bins are wide.  What they find sets the poles of the base for all that follows.
2. Optimal weights (`cpunet.training.optimal_weights`), again and again until nothing moves: all
   fits end in the same response, whatever their noise.
3. If the fit is poor, a ringing is tried, or, if pulses begin differently than simulated, the
   U-Net in front; see `cpunet.training.drift_training`.  As a line alone does not tell how
   charge clouds depend on energy, single sites of the continuum are compared there, too.

No discriminator network is trained.  What these moments do not see, the classifier of a
validation tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_pile_up import DrawnTails
from cpunet.networks.learned_response import LearnedResponse, StepResponse
from cpunet.pulses.container import Pulses
from cpunet.recipes.schema import LearnedConfig, Recipe
from cpunet.training.drift_training import changed, fit_drift
from cpunet.training.fitter import Fitted, Fitter
from cpunet.training.levenberg_marquardt import FIRST_CLIPS, Listener
from cpunet.training.moments import Values
from cpunet.training.optimal_weights import refine
from cpunet.training.pulse_sets import Continuum, PulseSets
from cpunet.training.response_fit import CHECKED, Fit, described
from cpunet.training.response_problem import Band, ResponseProblem
from cpunet.training.response_starts import RINGS, onset_is_off

# Width of the bins of the current amplitude and pulses of each side in the first fit from afar,
# and the width in the second.
FIRST_WIDTH, FIRST_PULSES, WIDTH = 0.2, 512, 0.05
POLE_NS = 19.2  # of the base of a step response, times one of the recipe's factors
# Rounds of optimal weights at most, and the move, in widths of the prior, below which they end.
ROUNDS, STILL = 8, 0.15


def fit_learned(
    sim: Pulses,
    data: Pulses,
    noise: BaselineNoise,
    recipe: Recipe,
    *,
    seed: int,
    known: LearnedResponse | None = None,
    tails: DrawnTails | None = None,
    continuum: Continuum | None = None,
    listener: Listener | None = None,
) -> tuple[LearnedResponse, Fit]:
    """Fit a learned readout; parameters as of `cpunet.training.response_fit.fit_response`.

    Of a known readout only the step response is a start: the U-Net is that of other pulses.
    """
    config, training = recipe.matching
    assert isinstance(config, LearnedConfig)
    config = config.model_copy(update={"drift": False})  # a U-Net is trained first
    sets = PulseSets(sim, data, noise, recipe, np.random.default_rng(seed), tails, continuum)
    fitter = Fitter(training, listener=listener)
    far = [band.with_wider_bins(FIRST_WIDTH) for band in sets.bands(FIRST_PULSES)]
    near = [band.with_wider_bins(WIDTH) for band in sets.bands(training.search_pulses)]
    found = None
    if known is not None:
        plain = known.config.model_copy(update={"drift": False})
        response = LearnedResponse(plain, noise.dt_ns)
        response.step.load_state_dict(known.step.state_dict())
        found = fitter.fit(ResponseProblem(response.step, near, draws=1), coarse=False)
    if found is None or found.poor:
        response, found = _from_afar(config, noise.dt_ns, far, near, fitter)
    tried = None
    single: list[Band] = []
    if found.poor and onset_is_off(found.problem):
        if training.drift_terms:
            single = sets.single_sites()
            tried = fit_drift(response, [*sets.bands(CHECKED), *single], WIDTH, fitter, seed)
    elif found.poor and training.ringing_mhz and not response.config.ringing:
        rings = response.config.model_copy(update={"ringing": True})
        other, better = _from_afar(rings, noise.dt_ns, far, near, fitter)
        if better.cost < RINGS * found.cost:
            response = other
    everything = sets.bands()
    if response.drift is None:
        covariance = _determined(response.step, everything, fitter)
    else:
        everything = changed([*everything, *single], response.drift)
        covariance = fitter.follow(ResponseProblem(response.step, everything, 2)).covariance
    fit = described(ResponseProblem(response.step, everything), covariance, fitter)
    return response, replace(fit, drift=tried)


def _from_afar(
    config: LearnedConfig,
    dt_ns: float,
    far: Sequence[Band],
    near: Sequence[Band],
    fitter: Fitter,
) -> tuple[LearnedResponse, Fitted]:
    """Fit a step response from the best of some bases, first by wide bins."""
    problems = []
    for factor in fitter.training.start_factors:
        problem = ResponseProblem(StepResponse(config, dt_ns), far, draws=1)
        problem.response.set_base(factor * POLE_NS, problem.slope)
        problem.clip = FIRST_CLIPS[-1]  # far from the data, all would be clipped
        problems.append(problem)
    best = min(problems, key=lambda problem: problem.cost)
    fitter.fit(best)
    best.response.set_base(best.response.pole_ns(), best.slope)
    response = LearnedResponse(config, dt_ns)
    response.step = best.response
    return response, fitter.fit(ResponseProblem(response.step, near, draws=1))


def _determined(step: StepResponse, bands: Sequence[Band], fitter: Fitter) -> Values:
    """Move a step response to where optimally weighted means agree; return its covariance."""
    near = ResponseProblem(step, bands)
    for _ in range(ROUNDS):
        before = near.parameters.vector()
        covariance = refine(near, bands, fitter.training.conditional_bins)
        after = near.parameters.vector()
        deviations = near.deviations(after)
        fitter.count(float(deviations @ deviations))
        if np.linalg.norm(after - before) < STILL:
            break
    return covariance
