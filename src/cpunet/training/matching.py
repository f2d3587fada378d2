"""A readout chain fitted to unpaired pulses: least squares on moments, with errors.

The parameters of a response are those for which the moments of the translated simulation,
noise and all, agree best with those of the data: a chi-square fit in about ten
parameters by the Levenberg–Marquardt method, with derivatives by finite differences on
fixed random numbers.  Its value says whether the response describes the data, its
curvature how well each parameter is known.
"""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.errors import CpunetError
from cpunet.networks.response import ROOM_AFTER, ROOM_BEFORE, ElectronicsResponse
from cpunet.pulses.container import FloatArray
from cpunet.recipes.network_settings import ResponseConfig
from cpunet.recipes.schema import Recipe
from cpunet.recipes.training_settings import MatchingConfig
from cpunet.training.levenberg_marquardt import Fit, Listener, levenberg_marquardt
from cpunet.training.moments import FEWEST, Moments
from cpunet.training.response_problem import ResponseProblem
from cpunet.training.ringing import most_promising_ringing

# Half maxima come at most this many samples after the aligned one: what the response delays.
DELAY = 100
# Chi-square per moment at which a fit has found its valley; the data's own outliers and the
# ridge keep it from 1.
GOOD_FIT = 1.6
# A wrong valley gives three per moment; this is another detector.
HOPELESS_FIT = 20.0
# A ringing must lower chi-square to this part of it, or there is none; derivatives far from
# where it would be promise less.
RINGS, PROMISES = 0.7, 0.9
# Samples from the half maximum up to which the drift alone shapes a pulse, and the standard
# deviations from which on that is not as it is simulated.
ONSET, OFF = -15, 4.0


def fit_response(
    sim: FloatArray,
    data: FloatArray,
    energy_kev: np.ndarray[tuple[int], np.dtype[np.float64]],
    noise: BaselineNoise,
    recipe: Recipe,
    *,
    seed: int,
    known: ElectronicsResponse | None = None,
    listener: Listener | None = None,
) -> tuple[ElectronicsResponse, Fit]:
    """Fit a response to unpaired prepared pulses.

    Parameters
    ----------
    sim, data
        Prepared windows, shapes (n, samples) and (n', samples).
    energy_kev
        Of the simulated pulses: the noise goes as its inverse.
    noise
        Of the data's baselines.
    recipe
        With a response to be matched.
    seed
        Of the choice of pulses, if there are many, and of the noise.
    known
        The response of a similar readout, of the recipe's configuration, to start from.  Only
        if that leads nowhere the recipe's own starts are tried.
    listener
        Told step and chi-square.

    Raises
    ------
    CpunetError
        If there are too few pulses, or the fit does not find a finite chi-square.
    """
    config, training = recipe.matching
    rng = np.random.default_rng(seed)
    if len(sim) < FEWEST:
        raise CpunetError(
            f"{len(sim)} simulated pulses; {FEWEST} or more are needed: select more energies "
            "(--peak) or simulate more"
        )
    sim_rows, data_rows = (
        np.sort(rng.choice(len(side), min(len(side), training.max_pulses), replace=False))
        for side in (sim, data)
    )
    moments = Moments.of_data(data[data_rows], training, recipe.preparation)
    sets = max(1, min(training.noise_sets, training.max_pulses // len(sim_rows)))
    length = ROOM_BEFORE + sim.shape[1] + ROOM_AFTER
    drawn = torch.from_numpy(
        np.stack([noise.draw(energy_kev[sim_rows], length, rng) for _ in range(-(-sets // 2))])
    )
    if listener is not None:
        listener = _counted(listener)
    first = ResponseProblem(
        ElectronicsResponse(config, noise.dt_ns),
        moments,
        torch.from_numpy(sim[sim_rows]),
        drawn[0],
        last=ROOM_BEFORE + recipe.preparation.samples_before + DELAY,
    )
    near = None if known is None else _from_known(first, known, training, listener)
    problem, fit = near or _best_start(first, config, training, listener)
    if _poor(fit):
        problem, fit = _ringing_if_better(problem, fit, config, training, listener)
    if sets > 1:
        # each draw once more with the other sign: what noise adds to a mean cancels
        problem.with_noise(torch.cat([drawn, -drawn])[:sets])
        again = levenberg_marquardt(problem, training.steps, listener, coarse=False)
        fit = replace(again, steps=fit.steps + again.steps)
    if _poor(fit) and _onset_is_off(fit, training):
        problem.allow_for_model_error()
        again = levenberg_marquardt(problem, training.steps, listener, coarse=False)
        # its own chi-square says nothing: what does not fit was allowed for
        fit = replace(again, chi_square=fit.chi_square, steps=fit.steps + again.steps)
    return problem.response, fit


def _poor(fit: Fit) -> bool:
    return fit.chi_square >= GOOD_FIT * fit.moments


def _onset_is_off(fit: Fit, training: MatchingConfig) -> bool:
    """Whether pulses begin otherwise than simulated: no readout does that, physics do.

    If only what follows is off, the data have what no readout chain has, such as remains of
    earlier pulses in their tails, and the edge is still to be trusted.
    """
    onset = [(a, b) for a, b in pairwise(training.segments) if b <= ONSET]
    return any(abs(fit.pulls[f"samples {a} to {b}"]) > OFF for a, b in onset)


def _from_known(
    first: ResponseProblem,
    known: ElectronicsResponse,
    training: MatchingConfig,
    listener: Listener | None,
) -> tuple[ResponseProblem, Fit] | None:
    """Fit from a response that is known, first as if the data were near; None if it is poor."""
    start = copy.deepcopy(known)
    _set_decay(start, float(first.moments.slope))
    problem, steps = first.of(start), 0
    for coarse in (False, True):
        fit = levenberg_marquardt(problem, training.steps, listener, coarse=coarse)
        steps += fit.steps
        if not _poor(fit):
            return problem, replace(fit, steps=steps)
    return None


def _best_start(
    first: ResponseProblem,
    config: ResponseConfig,
    training: MatchingConfig,
    listener: Listener | None,
) -> tuple[ResponseProblem, Fit]:
    """Fit from start after start, until one is good or all are done."""
    best: tuple[ResponseProblem, Fit] | None = None
    dt_ns, slope = float(first.response.dt_ns), float(first.moments.slope)
    for factor in training.start_factors:
        problem = first.of(_start(config, dt_ns, factor, slope))
        fit = levenberg_marquardt(problem, training.steps, listener)
        if best is None or fit.chi_square < best[1].chi_square:
            best = problem, fit
        if not GOOD_FIT <= fit.chi_square / fit.moments <= HOPELESS_FIT:
            break  # no other valley is to be looked for
    assert best is not None  # the recipe has one start at least
    return best


def _ringing_if_better(
    problem: ResponseProblem,
    fit: Fit,
    config: ResponseConfig,
    training: MatchingConfig,
    listener: Listener | None,
) -> tuple[ResponseProblem, Fit]:
    """Let the response ring, if that promises to explain much of what it leaves."""
    if config.ringing_mhz is not None:
        return problem, fit
    response, promised = most_promising_ringing(problem, config, training.ringing_mhz)
    if response is None or promised > PROMISES * fit.chi_square:
        return problem, fit
    best, steps = (problem, fit), fit.steps
    # from where the fit without ringing ended, first as if that were near, then as if far
    for coarse in (False, True):
        rings = problem.of(copy.deepcopy(response))
        found = levenberg_marquardt(rings, training.steps, listener, coarse=coarse)
        steps += found.steps
        if found.chi_square < RINGS * best[1].chi_square:
            best = rings, found
        if not _poor(best[1]):
            break
    return best[0], replace(best[1], steps=steps)


def _counted(listener: Listener) -> Listener:
    """A listener told the steps of all fits as one count."""
    steps = itertools.count(1)
    return lambda _, chi_square: listener(next(steps), chi_square)


def _start(
    config: ResponseConfig, dt_ns: float, factor: float, slope: float
) -> ElectronicsResponse:
    """A response with the recipe's poles times a factor, and the data's own decay."""
    response = ElectronicsResponse(config, dt_ns)
    response.log_poles_ns.data.add_(math.log(factor))
    _set_decay(response, slope)
    return response


def _set_decay(response: ElectronicsResponse, slope: float) -> None:
    """Take the data's own decay, if it has one."""
    if slope < 0:
        response.log_decay_us.data.fill_(math.log(-float(response.dt_ns) * 1e-3 / slope))
