"""What else explains the data: other chains, and other physics.

A chain of fixed times that does not fit leaves more than a larger chi-square. The parameters of
the physics absorb part of the deviation: a readout with an early decay between the fixed ones
looks like more self-repulsion. Physics that explain the pulses equally well are put side by
side with what they predict for energies that were not used.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cpunet.calibration.joint_problem import JointProblem
from cpunet.calibration.nearby import Simulator
from cpunet.calibration.nuisances import Values
from cpunet.networks.response_layer import ElectronicsResponse, padding
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import current_amplitude, drift_time
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import MatchingConfig, Recipe
from cpunet.simulation.hits import Hits
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
    if (
        chain.config.ringing_mhz is not None
        or problem.chi_square() < GOOD_FIT * problem.moments
    ):
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
    if problem.chi_square() < mean + BEYOND_CHANCE * spread:
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
    return (
        None
        if tried.chi_square() > problem.chi_square() - NEEDED
        else tried.parameters.chain.response
    )


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


def _at_these_physics(
    problem: JointProblem, chain: ElectronicsResponse, sets: PulseSets, training: MatchingConfig
) -> ResponseProblem:
    """Comparison for the chain alone, of some of the pulses with the physics of a problem."""
    waveforms = problem.windows(problem.parameters.coordinates)
    bands = [
        replace(band, sim=replace(band.sim, sim=waveforms[band.rows]))
        for band in sets.bands(training.search_pulses)
    ]
    return ResponseProblem(chain, bands, draws=1)


# Besides the lines, what most measurements of thorium have much of.
CONTINUUM = "1000-1500"
# Events of a line for a prediction, at least and at most.
LEAST, MAX_PULSES = 100, 500
# Difference of two predictions, in its error with the events simulated, that tells them apart.
DECIDES = 3.0
# Fraction of the charge with which the drift ends; on a flat top rounding finds the maximum.
COLLECTED = 0.99
_NUMBERS = ("current_amplitude", "drift_time")


def side_by_side(
    fits: Sequence[tuple[JointProblem, float]],
    hits: Hits,
    recipe: Recipe,
    used: EnergySelection,
) -> tuple[list[dict[str, float]], list[str]]:
    """Each of the physics, and what they predict for energies that were not used.

    Parameters
    ----------
    fits
        The physics, each with its chain, and the rise of chi-square; first those of the
        calibration.
    hits
        All simulated events.
    recipe
        Recipe with lines and preparation.
    used
        Energies of the calibration.

    Returns
    -------
    list of dict, list of str
        Of each of the physics the values of what is free in any, the rise of chi-square, and
        by line the medians of current amplitude and drift time (ns); the lines that would tell
        the physics apart, the best first.
    """
    energy_kev = np.add.reduceat(hits.edep_kev, hits.offsets[:-1])
    free, apart = ~used.select(energy_kev), {}
    physics = fits[0][0].nearby.simulator.physics
    chosen = {i for problem, _ in fits for i in problem.parameters.free}
    names = [physics.nuisances[i].name for i in sorted(chosen)]
    found = []
    for problem, rise in fits:
        values = physics.values(problem.parameters.coordinates)
        found.append({**{name: values[name] for name in names}, "chi_square_rise": rise})
    for line in (*recipe.peaks, CONTINUUM):
        rows = np.flatnonzero(free & parse_selection(line, recipe.peaks).select(energy_kev))
        if len(rows) < LEAST:
            continue
        some = rows[:MAX_PULSES]
        of = [_numbers(one, hits[some], energy_kev[some], recipe) for one, _ in fits]
        apart[line] = 0.0
        for name in _NUMBERS:
            medians = [float(np.nanmedian(one[name])) for one in of]
            for one, median in zip(found, medians, strict=True):
                one[f"{line}_{name}"] = median
            low, high = np.nanquantile(of[0][name], (0.16, 0.84))
            # of the difference between the medians of a simulation and of as many pulses
            error = float(1.25 * 0.5 * (high - low) * np.sqrt(2 / len(rows)))
            apart[line] = max(apart[line], float(np.ptp(medians) / error))
    best = sorted(apart, key=lambda line: -apart[line])
    return found, [line for line in best if apart[line] > DECIDES]


def _numbers(
    problem: JointProblem, hits: Hits, energy_kev: Values, recipe: Recipe
) -> dict[str, Values]:
    """Current amplitude after the chain, and drift time before it, without noise."""
    physics, parameters = problem.nearby.simulator.physics, problem.parameters
    waveforms = Simulator(hits, physics).exact(parameters.coordinates)
    pulses = Pulses.of(waveforms, dt_ns=physics.settings.dt_ns, energy_kev=energy_kev)
    windows = prepare(pulses, recipe.preparation, "simulated").pulses
    records = parameters.chain.response(windows.waveforms)
    records /= records[:, -padding(pulses.dt_ns)[1] :].mean(axis=1, keepdims=True)
    ends = np.minimum(windows.waveforms, COLLECTED)
    return {
        "current_amplitude": current_amplitude(records, pulses.dt_ns),
        "drift_time": drift_time(ends, pulses.dt_ns, recipe.scores.drift_start_fraction),
    }
