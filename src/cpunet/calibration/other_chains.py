"""Other chains, for data that a chain of fixed times does not explain.

A chain that does not fit leaves more than a larger chi-square. The parameters of the physics
absorb part of the deviation: a readout with an early decay between the fixed ones looks like
more self-repulsion.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

from cpunet.calibration.joint_problem import JointProblem
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.schema import MatchingConfig
from cpunet.training.fitter import GOOD_FIT, Fitted, Fitter
from cpunet.training.levenberg_marquardt import levenberg_marquardt
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_problem import ResponseProblem
from cpunet.training.response_starts import ringing_if_better, with_free_decay

STEPS = 12
# Chi-square beyond chance, in its standard deviations, for which another chain is tried.
BEYOND_CHANCE = 4.0
# Decrease of chi-square (five standard deviations) for which the time of a decay is freed.
NEEDED = 25.0


def ringing_chain(
    problem: JointProblem, sets: PulseSets, training: MatchingConfig
) -> ElectronicsResponse | None:
    """Return a chain with ringing if it explains much of the remaining deviation."""
    chain = copy.deepcopy(problem.parameters.chain.response)
    if chain.config.ringing_mhz is not None or _cost(problem) < GOOD_FIT * problem.moments:
        return None
    plain = _at_these_physics(problem, chain, sets, training)
    found = levenberg_marquardt(plain, STEPS, None, coarse=False)
    fitted = Fitted(plain, found.cost, found.covariance)
    if not fitted.poor:
        return None
    best = ringing_if_better(fitted, Fitter(training)).problem.response
    return best if len(best.ringing) else None


def decaying_chain(
    problem: JointProblem, sets: PulseSets, training: MatchingConfig
) -> ElectronicsResponse | None:
    """Return a chain with one early decay of free time if the data need it.

    The main decay is constrained to that of the tails, if these are known.
    """
    mean, spread = problem.by_chance
    if _cost(problem) < mean + BEYOND_CHANCE * spread:
        return None
    chain = copy.deepcopy(problem.parameters.chain.response)
    plain = _at_these_physics(problem, chain, sets, training)
    tails = sets.tails
    decay = None if tails is None else tails.known_decay
    other = with_free_decay(plain, Fitter(training, decay))
    if other is None:
        return None
    tried = problem.of_chain(other.problem.response)
    levenberg_marquardt(tried, STEPS, None, coarse=False)
    return None if _cost(tried) > _cost(problem) - NEEDED else tried.parameters.chain.response


OtherChain = Callable[[JointProblem, PulseSets, MatchingConfig], ElectronicsResponse | None]
# The round in which each is first tried: no physics can replace the ringing of a readout, but
# early decays are visible only when the physics are about right.
OTHER_CHAINS: dict[OtherChain, int] = {ringing_chain: 1, decaying_chain: 2}


def other_chain(
    problem: JointProblem,
    sets: PulseSets,
    training: MatchingConfig,
    kinds: dict[OtherChain, int],
    number: int,
    *,
    settled: bool,
) -> ElectronicsResponse | None:
    """Another chain if the data need one in this round. Each kind is used at most once."""
    for kind in [kind for kind, first in kinds.items() if settled or number == first]:
        chain = kind(problem, sets, training)
        if settled or chain is not None:
            del kinds[kind]
        if chain is not None:
            return chain
    return None


def _cost(problem: JointProblem) -> float:
    return problem.chi_square(problem.parameters.vector())


def _at_these_physics(
    problem: JointProblem, chain: ElectronicsResponse, sets: PulseSets, training: MatchingConfig
) -> ResponseProblem:
    """Comparison for the chain alone, of some of the pulses with the physics of a problem."""
    waveforms = problem.prepared(problem.parameters.coordinates).waveforms
    bands = [
        replace(band, sim=replace(band.sim, sim=waveforms[band.rows]))
        for band in sets.bands(training.search_pulses)
    ]
    return ResponseProblem(chain, bands, draws=1)
