"""Starting points of the fit of a chain, and what may be added to it.

A fit only finds the minimum of the valley that it starts in.  There are therefore several
starts.  A stretch of the simulated drift and, in a calibration, a fast decay with a free time
and a ringing are kept only if held-out pulses gain, see `cpunet.training.fitter`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence

import numpy as np

from cpunet.electronics.drawn_pile_up import KnownDecay
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.schema import ResponseConfig
from cpunet.training.chain_parameters import with_decay, with_settings
from cpunet.training.fitter import Fitted, Fitter, held_out_gain
from cpunet.training.response_problem import ResponseProblem

# A ringing must lower chi-square to this fraction, and promise the next: derivatives
# far from the minimum underestimate the decrease.
RINGS, PROMISES = 0.7, 0.9
# What is added must lower chi-square by this much, four standard deviations.  A stretch that is
# 0 within this many of its own is not needed.  Drift that is longer or shorter by more than a
# third is that of another detector.
ADDS, SURE, MAX_STRETCH = 16.0, 3.0, 1 / 3
# Parts that are tried, as the user reads them.
RINGING = "a ringing"
DRIFT = {1: "a stretch of the drift", 2: "its change with time"}  # by number of terms
# Starting times of a free fast decay in us, and its shares.
FAST_DECAYS_US, SHARES = (1.5, 3.0, 6.0), (-0.05, -0.02, 0.02, 0.05, 0.1)
MIN_SHARE, MAX_SHARE = 0.005, 0.2
# A longer overshoot resembles a fast decay, and would be a second valley.
SLOWEST_NS = 800.0
# Minimum relative error of a main decay known from pile-up tails: these are fitted
# with one exponential, and a readout may have more.
MIN_DECAY_ERROR = 0.01
# Sample from the half maximum up to which drift alone shapes a pulse, and pull above which this
# part disagrees with the simulation.
ONSET_NS, OFF = -240.0, 4.0


def gains(part: str, before: Fitted, after: Fitted, fitter: Fitter) -> bool:
    """Whether a part that was added lowers chi-square, that of held-out pulses, too."""
    if after.cost > before.cost - ADDS:
        return False
    cases = [(found.problem.response, None) for found in (before, after)]
    gain = held_out_gain(cases, before.problem.bands, fitter)
    fitter.gains[part] = f"{'kept' if gain.best else 'left out'}; {gain}"
    return gain.best > 0


def with_free_decay(problem: ResponseProblem, fitter: Fitter) -> Fitted | None:
    """Fit a response with one free fast decay; None if decays are free already or absent."""
    config = problem.response.config
    if config.free_decays or not config.fast_decays_us:
        return None
    slow = tuple(tau for tau in config.slow_ns if tau <= SLOWEST_NS)
    free = config.model_copy(
        update={"free_decays": True, "fast_decays_us": FAST_DECAYS_US[:1], "slow_ns": slow}
    )
    found = []
    for with_slow in (False, True):  # either may end in another valley
        starts = _free_decay_starts(problem, free, fitter.decay, with_slow)
        best = min(starts, key=lambda start: start.cost)
        found.append(fitter.fit(best, coarse=not with_slow))
    return min(found, key=lambda fit: fit.cost)


def _free_decay_starts(
    problem: ResponseProblem, config: ResponseConfig, decay: KnownDecay | None, with_slow: bool
) -> Iterator[ResponseProblem]:
    """Comparisons for fast and main decays that together match the data's tails.

    Fits that start from tails of another slope get lost, and a share of 0 does not constrain
    the time.  If the main decay is known, the share follows from how much steeper the tails
    are.  The bandwidth found without the fast decay, and perhaps the slow parts, are about
    right if the tails are.
    """
    known, preparation = problem.response, problem.bands[0].moments.preparation
    dt_ns, dt_us = float(known.dt_ns), 1e-3 * float(known.dt_ns)
    middle_us = (preparation.samples_after - 0.5 * preparation.decay_fit_samples) * dt_us
    for fast_us in FAST_DECAYS_US:
        # increase of the slope of the tails by a share of 1, per us
        steeper = math.exp(-middle_us / fast_us) / fast_us
        shares: Sequence[float] = SHARES
        if decay is not None:
            share = (-problem.slope / dt_us - 1 / decay.us) / steeper
            shares = (min(max(share, MIN_SHARE), MAX_SHARE),)
        for share in shares:
            response = ElectronicsResponse(config, dt_ns)
            with_decay(response, problem.slope + dt_us * share * steeper, decay)
            response.log_poles_ns[:] = known.log_poles_ns
            if with_slow:
                kept = [tau in config.slow_ns for tau in known.config.slow_ns]
                response.slow_weights[:] = known.slow_weights[kept]
            if response.drift is not None and known.drift is not None:
                response.drift.fill(known.drift.arrays())
            response.log_fast_decays_us[:] = math.log(fast_us)
            response.decay_weights[:] = share
            yield problem.of(response)


def ringing_if_better(found: Fitted, fitter: Fitter) -> Fitted:
    """Add a ringing to the response if that explains much of the remaining chi-square."""
    problem = found.problem
    if problem.response.config.ringing_mhz is not None:
        return found
    response, promised = most_promising_ringing(problem, fitter.training.ringing_mhz)
    if response is None or promised > PROMISES * found.cost:
        return found
    best = found
    # from the end of the fit without ringing, first as if that were near, then as if far
    for coarse in (False, True):
        rings = problem.of(copy.deepcopy(response))
        again = fitter.fit(rings, coarse=coarse)
        if again.cost < RINGS * best.cost and gains(RINGING, found, again, fitter):
            best = again
        if not best.poor:
            break
    return best


def most_promising_ringing(
    problem: ResponseProblem, frequencies_mhz: Sequence[float]
) -> tuple[ElectronicsResponse | None, float]:
    """Look for the ringing that would lower chi-square most.

    A fit does not find the frequency of a ringing from a distant start: chi-square as a
    function of the frequency has many valleys.  But pulses depend nearly linearly on the two
    weights of the ringing.  The best weights for each frequency on a grid, and the expected
    chi-square, therefore follow from the derivatives at zero weights.

    Parameters
    ----------
    problem
        Problem of a fitted response without ringing.
    frequencies_mhz
        Frequencies to try.

    Returns
    -------
    response
        A copy of the response with a ringing of the best frequency and zero weights; None if
        there are no frequencies.
    promised
        Chi-square expected with it, to first order.
    """
    vector = problem.parameters.vector()
    problem.clip = None
    deviations = problem.deviations(vector)
    best: tuple[ElectronicsResponse | None, float] = (None, float(deviations @ deviations))
    for frequency in frequencies_mhz:
        response = with_settings(problem.response, ringing_mhz=frequency)
        tried = problem.of(response)
        columns = tried.derivatives(tried.parameters.vector())
        move = np.linalg.lstsq(columns, deviations)[0]
        left = deviations - columns @ move
        if float(left @ left) < best[1]:
            best = response, float(left @ left)
    return best
