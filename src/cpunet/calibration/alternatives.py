"""Physics that explain the pulses equally well, side by side.

Each predicts something for energies that were not used.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cpunet.calibration.joint_problem import JointProblem
from cpunet.calibration.nearby import Simulator
from cpunet.calibration.nuisances import Values
from cpunet.networks.response_layer import padding
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import current_amplitude, drift_time
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import Recipe
from cpunet.simulation.hits import Hits

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
