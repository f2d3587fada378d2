"""Result of a calibration, and its plain numbers for storage and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cpunet.calibration.identifiability import Information, together
from cpunet.calibration.joint_problem import JointProblem
from cpunet.calibration.nuisances import Physics, Values
from cpunet.networks.response_layer import ElectronicsResponse

OFFSETS = (-1.5, 0.0, 1.5)  # of a profile, in errors
# Number of prior errors beyond which a parameter is reported as unexpected.
FAR = 3.0
# Chi-square beyond chance, in its standard deviations, that is too much.
BEYOND_CHANCE = 4.0
# Advice where a parameter is unexpected, besides the general one.
ADVICE = {
    "self_repulsion": "it acts within each hit, so hits that are not merged within "
    "0.2 mm (cluster_mm), as tracks are long, need more of it"
}
# Minimum decrease of chi-square that is reported for a further parameter.
WORTH_TELLING = 9.0


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Chain and physics that explain the data.

    Parameters
    ----------
    problem
        Comparison at the end of the search: chain, coordinates, functions, pulses.
    covariance
        Covariance of its parameters, with errors of the functions larger by `scale`.
    chi_square_before, pulls_before
        Chi-square and pulls with the chain alone, for the physics as simulated.
    chi_square
        Chi-square with chain and physics.
    scale
        Factor of the errors from imperfect agreement, see `JointProblem.by_chance`.
    information
        Information on all physics.
    promised
        Expected decrease of chi-square for each fixed parameter if it were free, by position.
    rounds, settled
        Number of rounds, and whether the physics was unchanged in the last one.
    alternatives
        All physics that explain the data about as well, these first, and by how much
        chi-square with priors is larger.
    """

    problem: JointProblem
    covariance: Values
    chi_square_before: float
    pulls_before: Values
    chi_square: float
    scale: float
    information: Information
    promised: dict[int, float]
    rounds: int
    settled: bool
    alternatives: Sequence[tuple[JointProblem, float]] = ()

    @property
    def response(self) -> ElectronicsResponse:
        """The chain."""
        chain: ElectronicsResponse = self.problem.parameters.chain.response
        return chain

    @property
    def physics(self) -> Physics:
        """Physics that the coordinates refer to."""
        return self.problem.nearby.simulator.physics


@dataclass(frozen=True)
class FreeParameter:
    """What was found for a free parameter, in its unit.

    Parameters
    ----------
    value, error
        Value, and its error with the fixed parameters as simulated.
    error_all
        Error with all parameters considered free.
    simulated
        Value as simulated.
    doubt
        Why the value is no finding, or None.
    prior
        ``value``, ``error`` and ``source``.
    """

    value: float
    error: float
    error_all: float
    simulated: float
    doubt: str | None
    prior: Mapping[str, float | str]


def described(calibrated: Calibrated) -> dict[str, Any]:
    """Content of ``calibration.json``.

    Returns
    -------
    dict
        ``parameters`` (each a `FreeParameter`) and ``fixed`` by name;
        ``together``: pairs of which only a combination is known, with its value and error in
        units of the priors; ``chi_square``; ``directions``; ``covariance`` of the
        coordinates; ``pulls`` of the functions, before and after; ``profiles``; ``notes``.
    """
    problem = calibrated.problem
    vector, n = problem.parameters.vector(), problem.parameters.n_chain
    mean, spread = problem.by_chance
    free = free_parameters(calibrated)
    return {
        "parameters": {name: asdict(one) for name, one in free.items()},
        "together": _together(calibrated),
        "fixed": _fixed(calibrated),
        "chi_square": {
            "before": calibrated.chi_square_before,
            "after": calibrated.chi_square,
            "moments": problem.moments,
            "degrees_of_freedom": problem.moments - len(vector),
            "by_chance": {"mean": mean, "standard_deviation": spread},
            "errors_scaled_by": calibrated.scale,
        },
        "directions": [found.describe() for found in calibrated.information.directions()],
        "covariance": {
            "names": list(problem.parameters.names),
            "values": vector[n:].tolist(),
            "matrix": calibrated.covariance[n:, n:].tolist(),
        },
        "pulls": {
            "names": list(problem.names),
            "before": calibrated.pulls_before.tolist(),
            "after": problem.pulls().tolist(),
        },
        "profiles": _profiles(calibrated),
        "rounds": calibrated.rounds,
        "settled": calibrated.settled,
        "notes": notes(calibrated, free),
    }


def notes(calibrated: Calibrated, free: Mapping[str, FreeParameter]) -> list[str]:
    """Remarks on the result of a calibration."""
    problem = calibrated.problem
    found = [
        f"the fit uses {name} = {one.value:.4g} to make up for something else "
        f"({one.doubt}): free what else moves pulses so, or give a `prior` if it can be"
        + (f"; {ADVICE[name]}" if name in ADVICE else "")
        for name, one in free.items()
        if one.doubt
    ]
    per = calibrated.chi_square / problem.moments
    mean, spread = (number / problem.moments for number in problem.by_chance)
    if per <= mean + BEYOND_CHANCE * spread:
        found.append(
            f"chi-square is {per:.2f} per function, expected from statistics ({mean:.2f} ± "
            f"{spread:.2f})" + ("" if found else ": no other physics are needed")
        )
        return found
    fall, best = max(((fall, i) for i, fall in calibrated.promised.items()), default=(0.0, 0))
    rest = "none of the parameters looked at explains it"
    if fall > WORTH_TELLING:
        name = calibrated.physics.nuisances[best].name
        rest = f"with {name} free, too, it would fall by {fall:.0f}"
    found.append(
        f"chi-square is {per:.2f} per function, a poor fit (expected from statistics: "
        f"{mean:.2f} ± {spread:.2f}); {rest}"
    )
    return found


def doubts(free: Mapping[str, FreeParameter]) -> str:
    """Comment on the parameters whose values are no findings, for the files of the physics."""
    return "".join(
        f"# {name}: unreliable value, makes up for something else ({one.doubt})\n"
        for name, one in free.items()
        if one.doubt
    )


def free_parameters(calibrated: Calibrated) -> dict[str, FreeParameter]:
    """What was found for each free parameter, by name."""
    parameters, physics = calibrated.problem.parameters, calibrated.physics
    centres, widths = physics.priors(parameters.given)
    errors = np.sqrt(calibrated.covariance.diagonal()[parameters.n_chain :])
    information = calibrated.information
    # sampling noise makes those with all free larger, too
    errors_all = information.errors()
    larger = errors / information.errors(parameters.free)
    free = {}
    for k, (i, error) in enumerate(zip(parameters.free, errors, strict=True)):
        name, x = physics.nuisances[i].name, float(parameters.coordinates[i])
        value, own_error = physics.in_own_unit(i, x, error)
        centre, width = physics.in_own_unit(i, float(centres[i]), widths[i])
        free[name] = FreeParameter(
            value=value,
            error=own_error,
            error_all=physics.in_own_unit(i, x, larger[k] * errors_all[i])[1],
            simulated=physics.nominal(physics.nuisances[i]),
            doubt=_doubt(calibrated, k, value),
            prior={
                "value": centre,
                "error": width,
                "source": "given" if name in parameters.given else physics.nuisances[i].source,
            },
        )
    return free


def _fixed(calibrated: Calibrated) -> dict[str, dict[str, float]]:
    """Each fixed parameter by name; fall of chi-square, and its error, if it were free."""
    parameters, physics = calibrated.problem.parameters, calibrated.physics
    found = {}
    for i, fall in calibrated.promised.items():
        error = calibrated.scale * calibrated.information.errors([*parameters.free, i])[-1]
        value, own_error = physics.in_own_unit(i, float(parameters.coordinates[i]), error)
        of_free = {"chi_square_would_fall_by": fall, "error_if_free": own_error}
        found[physics.nuisances[i].name] = {"value": value} | of_free
    return found


def _doubt(calibrated: Calibrated, k: int, value: float) -> str | None:
    """Why the value of the free parameter number `k` is no finding."""
    parameters = calibrated.problem.parameters
    low, high = calibrated.physics.nuisances[parameters.free[k]].possible
    k += parameters.n_chain
    x = parameters.vector()[k]
    off = abs(x - parameters.centre[k]) / parameters.widths[k]
    if x in (parameters.low[k], parameters.high[k]) and value != 0:  # none of it can be true
        return "at its bound"
    if not low <= value <= high:
        return f"{low:g} to {high:g} is possible"
    return f"{off:.1f} errors of its prior from it" if off > FAR else None


def _together(calibrated: Calibrated) -> list[dict[str, dict[str, float] | float | str]]:
    """Pairs of free parameters of which only a combination is known."""
    parameters = calibrated.problem.parameters
    n = parameters.n_chain
    names, widths = parameters.names, parameters.widths[n:]
    off = (parameters.vector()[n:] - parameters.centre[n:]) / widths
    at = dict(zip(names, off.tolist(), strict=True))
    return [
        {
            **one.describe(),
            "value": sum(size * at[name] for name, size in one.components.items()),
        }
        for one in together(names, calibrated.covariance[n:, n:] / np.outer(widths, widths))
    ]


def _profiles(calibrated: Calibrated) -> dict[str, dict[str, list[float]]]:
    """Chi-square including priors along the valley of each free coordinate.

    All others are where they are best if the valley is a parabola.
    """
    problem, physics = calibrated.problem, calibrated.physics
    parameters = problem.parameters
    here, n = parameters.vector(), parameters.n_chain
    found = {}
    for k, i in enumerate(parameters.free, n):
        error = float(np.sqrt(calibrated.covariance[k, k]))
        valley = calibrated.covariance[:, k] / error
        nuisance = physics.nuisances[i]
        nominal = physics.nominal(nuisance)
        values, costs = [], []
        for offset in OFFSETS:
            x = float(here[k] + offset * error)
            added = nuisance.kind == "added"  # told without bounds
            values.append(nominal + x if added else nuisance.value(nominal, x))
            there = np.clip(here + offset * valley, parameters.low, parameters.high)
            residuals = problem.residuals(there)
            costs.append(float(residuals @ residuals))
        found[nuisance.name] = {"value": values, "chi_square": costs}
    parameters.set(here)
    return found
