"""Fit the learned readout and the U-Net before it to unpaired pulses: the recipe ``cpunet``.

1. A linear discriminator, solved: the moments that separate the two sides best are those of
   `cpunet.training.moments`; the step response moves until they agree (Gauss-Newton with exact
   derivatives).  Far from the data, narrow bins of the current amplitude are blind, so the
   first bins are wide.
2. Optimal weights (`cpunet.training.optimal_weights`), again and again until nothing moves: all
   fits end in the same response, whatever their noise.
3. If the fit is poor, a ringing is tried, or, if pulses begin differently than simulated, the
   U-Net in front; see `cpunet.training.drift_training`.

No discriminator is trained: where these moments agree, one that is trained on half of the
pulses finds no difference in the other half; see the results.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_remains import DrawnRemains
from cpunet.networks.learned_response import LearnedResponse, StepResponse
from cpunet.pulses.container import Pulses
from cpunet.recipes.network_settings import LearnedConfig
from cpunet.recipes.schema import Recipe
from cpunet.training.drift_training import DriftFit, changed, fit_drift
from cpunet.training.fitter import Fitted, Fitter
from cpunet.training.levenberg_marquardt import FIRST_CLIPS, Listener
from cpunet.training.moments import Values
from cpunet.training.optimal_weights import refine
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_fit import CHECKED, Fit, described
from cpunet.training.response_problem import Band, ResponseProblem
from cpunet.training.response_starts import RINGS, onset_is_off

# Widths of the bins of the current amplitude, and pulses of each side, one fit after another.
STAGES = ((0.2, 512), (0.05, 2048))
POLES_NS = 19.2 * 1.25 ** np.arange(9)  # that are tried for the base of the step response
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
    remains: DrawnRemains | None = None,
    listener: Listener | None = None,
) -> tuple[LearnedResponse, Fit, DriftFit | None]:
    """Fit a learned readout; parameters as of `cpunet.training.response_fit.fit_response`.

    Returns
    -------
    tuple
        The readout, how well it describes the data, and what the U-Net gains if it was tried.
    """
    config, training = recipe.matching
    assert isinstance(config, LearnedConfig)
    torch.manual_seed(seed)
    sets = PulseSets(sim, data, noise, recipe, np.random.default_rng(seed), remains)
    fitter = Fitter(training, None if remains is None else remains.known_decay, listener)
    stages = [sets.bands(most, width) for width, most in STAGES]
    response, found = _fitted(config, stages, noise.dt_ns, fitter, known)
    tried: DriftFit | None = None
    if found.poor:
        if onset_is_off(found.problem):
            tried = fit_drift(response, sets.bands(CHECKED), stages[-1], fitter, seed)
        elif not config.ringing:
            rings = config.model_copy(update={"ringing": True})
            other, better = _fitted(rings, stages, noise.dt_ns, fitter)
            if better.cost < RINGS * found.cost:
                response = other
    everything = changed(sets.bands(), response.drift)
    if response.drift is None:
        covariance = _determined(response.step, everything, fitter)
    else:
        covariance = fitter.follow(ResponseProblem(response.step, everything, 2)).covariance
    fit = described(ResponseProblem(response.step, everything), covariance, fitter.steps)
    return response, fit, tried


def _fitted(
    config: LearnedConfig,
    stages: Sequence[Sequence[Band]],
    dt_ns: float,
    fitter: Fitter,
    known: LearnedResponse | None = None,
) -> tuple[LearnedResponse, Fitted]:
    """Fit a step response to some of the pulses, from the best base or a known response."""
    if known is not None:
        found = fitter.fit(ResponseProblem(known.step, stages[-1], draws=1), coarse=False)
        return known, found
    starts = [LearnedResponse(config, dt_ns) for _ in POLES_NS]
    problems = [ResponseProblem(start.step, stages[0], draws=1) for start in starts]
    for pole_ns, problem in zip(POLES_NS, problems, strict=True):
        step = problem.response
        assert isinstance(step, StepResponse)
        step.set_base(float(pole_ns), problem.slope)
    best = min(range(len(starts)), key=lambda i: _distance(problems[i]))
    response, found = starts[best], fitter.fit(problems[best])
    for bands in stages[1:]:
        found = fitter.fit(ResponseProblem(response.step, bands, draws=1), coarse=False)
    return response, found


def _distance(problem: ResponseProblem) -> float:
    """Cost far from the data, where all would be clipped."""
    problem.clip = FIRST_CLIPS[-1]
    residuals = problem.residuals(problem.parameters.vector())
    return float(residuals @ residuals)


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
