"""Result of a calibration, and its plain numbers for storage and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cpunet.calibration.identifiability import Information, together
from cpunet.calibration.joint_problem import JointParameters, JointProblem
from cpunet.calibration.nuisances import Nuisance, Values, known_before
from cpunet.calibration.other_chains import BEYOND_CHANCE
from cpunet.networks.response_layer import ElectronicsResponse

# Offsets of a profile in errors, and steps in which the other parameters are minimised.
OFFSETS, FOLLOWING = (-2.0, -1.0, 0.0, 1.0, 2.0), 2
# Number of prior errors beyond which a parameter is reported as unexpected.
FAR = 3.0
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
        Covariance of its parameters, multiplied by the square of `scale`.
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
    def errors(self) -> Values:
        """Standard errors of the free coordinates."""
        n = self.problem.parameters.n_chain
        return np.asarray(np.sqrt(self.covariance.diagonal()[n:]))


def described(calibrated: Calibrated) -> dict[str, Any]:
    """Content of ``calibration.json``.

    Returns
    -------
    dict
        ``parameters``: value, error (with the parameters below as simulated), error_all (with
        all parameters considered free), simulated value and prior of each free parameter, and
        ``doubt``, why its value is no finding, or None; ``together``: pairs of which only a
        combination is known, with its value and error in units of the priors;
        ``fixed``: parameters considered but kept as simulated, with the decrease of chi-square
        and the error expected if they were free; ``chi_square``; ``directions``;
        ``covariance`` of chain and coordinates; ``pulls`` of the functions, before and after;
        ``profiles``; ``notes``.
    """
    problem = calibrated.problem
    vector = problem.parameters.vector()
    mean, spread = problem.by_chance
    return {
        "parameters": _parameters(calibrated),
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
            "values": vector.tolist(),
            "matrix": calibrated.covariance.tolist(),
        },
        "pulls": {
            "names": list(problem.names),
            "before": calibrated.pulls_before.tolist(),
            "after": problem.pulls(vector).tolist(),
        },
        "profiles": _profiles(calibrated),
        "rounds": calibrated.rounds,
        "settled": calibrated.settled,
        "notes": notes(calibrated),
    }


def notes(calibrated: Calibrated) -> list[str]:
    """Remarks on the result of a calibration."""
    problem = calibrated.problem
    found = [
        f"the fit uses {name} = {one['value']:.4g} to make up for something else "
        f"({one['doubt']}): free what else moves pulses so, or give a `prior` if it can be"
        + (f"; {ADVICE[name]}" if name in ADVICE else "")
        for name, one in _parameters(calibrated).items()
        if one["doubt"]
    ]
    per = calibrated.chi_square / problem.moments
    physics = problem.nearby.simulator.physics
    asked = {
        physics.nuisances[i].name: fall
        for i, fall in calibrated.promised.items()
        if fall > WORTH_TELLING
    }
    best = max(asked, key=lambda name: asked[name], default=None)
    mean, spread = (number / problem.moments for number in problem.by_chance)
    if per <= mean + BEYOND_CHANCE * spread:
        found.append(
            f"chi-square is {per:.2f} per function, as by chance ({mean:.2f} ± {spread:.2f})"
            + ("" if found else ": no other physics are needed")
        )
    else:
        rest = (
            f"with {best} free, too, it would fall by {asked[best]:.0f}"
            if best
            else "none of the parameters looked at explains it"
        )
        found.append(
            f"chi-square is {per:.2f} per function, too much for chance ({mean:.2f} ± "
            f"{spread:.2f}); {rest}"
        )
    return found


def doubts(parameters: Mapping[str, Any]) -> str:
    """Comment on the parameters whose values are no findings, for the files of the physics."""
    lines = [
        f"# {name}: no finding, makes up for something else ({one['doubt']})\n"
        for name, one in parameters.items()
        if one["doubt"]
    ]
    return "".join(lines)


def _parameters(calibrated: Calibrated) -> dict[str, Any]:
    """Value, errors, simulated value, prior and doubt of each free parameter, by name."""
    problem = calibrated.problem
    parameters, physics = problem.parameters, problem.nearby.simulator.physics
    values = physics.values(parameters.coordinates)
    before, n = known_before(physics, parameters.given), parameters.n_chain
    errors_all = calibrated.scale * calibrated.information.errors()
    free = {}
    for k, (i, error) in enumerate(zip(parameters.free, calibrated.errors, strict=True)):
        nuisance = physics.nuisances[i]
        nominal, value = physics.nominal(nuisance), values[nuisance.name]
        slope = nuisance.slope(nominal, value)
        centre, width = before[nuisance.name]
        free[nuisance.name] = {
            "value": value,
            "error": float(slope * error),
            "error_all": float(slope * errors_all[i]),
            "simulated": nominal,
            "doubt": _doubt(nuisance, value, parameters, n + k),
            "prior": {
                "value": centre,
                "error": width,
                "source": "given" if nuisance.name in parameters.given else nuisance.source,
            },
        }
    return free


def _fixed(calibrated: Calibrated) -> dict[str, Any]:
    """Value of each fixed parameter; fall of chi-square and error if it were free."""
    parameters = calibrated.problem.parameters
    physics = calibrated.problem.nearby.simulator.physics
    values, found = physics.values(parameters.coordinates), {}
    for i, fall in calibrated.promised.items():
        nuisance = physics.nuisances[i]
        error = calibrated.scale * calibrated.information.errors([*parameters.free, i])[-1]
        value = values[nuisance.name]
        found[nuisance.name] = {
            "value": value,
            "chi_square_would_fall_by": fall,
            "error_if_free": float(nuisance.slope(physics.nominal(nuisance), value) * error),
        }
    return found


def _doubt(nuisance: Nuisance, value: float, parameters: JointParameters, k: int) -> str | None:
    """Why the value of a parameter, number `k` of all, is no finding."""
    x = parameters.vector()[k]
    off = abs(x - parameters.centre[k]) / parameters.widths[k]
    low, high = nuisance.possible
    if x in (parameters.low[k], parameters.high[k]) and value != 0:  # none of it can be true
        return "at its bound"
    if not low <= value <= high:
        return f"{low:g} to {high:g} is possible"
    return f"{off:.1f} errors of its prior from it" if off > FAR else None


def _together(calibrated: Calibrated) -> list[dict[str, Any]]:
    """Pairs of free parameters of which only a combination is known."""
    parameters = calibrated.problem.parameters
    n = parameters.n_chain
    names, widths = parameters.names[n:], parameters.widths[n:]
    off = (parameters.vector()[n:] - parameters.centre[n:]) / widths
    at = dict(zip(names, off.tolist(), strict=True))
    return [
        {
            **one.describe(),
            "value": sum(size * at[name] for name, size in one.components.items()),
        }
        for one in together(names, calibrated.covariance[n:, n:] / np.outer(widths, widths))
    ]


def _profiles(calibrated: Calibrated) -> dict[str, Any]:
    """Chi-square including priors along the valley of each free coordinate."""
    problem = calibrated.problem
    parameters, physics = problem.parameters, problem.nearby.simulator.physics
    here, n = parameters.vector(), parameters.n_chain
    if not parameters.free:
        return {}
    jacobian = problem.jacobian(here, problem.residuals(here))
    found = {}
    for k, i in enumerate(parameters.free):
        others = [j for j in range(len(here)) if j != n + k]
        follow = np.asarray(np.linalg.pinv(jacobian[:, others]), float)
        error = float(np.sqrt(calibrated.covariance[n + k, n + k]))
        valley = calibrated.covariance[:, n + k] / error
        nuisance = physics.nuisances[i]
        nominal = physics.nominal(nuisance)
        values, costs = [], []
        for offset in OFFSETS:
            moved = here.copy()
            moved[n + k] += offset * error
            values.append(_unbounded(nuisance, nominal, float(moved[n + k])))
            starts = (moved, here + offset * valley)
            costs.append(min(_lowest(problem, s, others, follow) for s in starts))
        found[nuisance.name] = {"value": values, "chi_square": costs}
    parameters.set(here)
    return found


def _lowest(problem: JointProblem, vector: Values, others: list[int], follow: Values) -> float:
    """Sum of squares with one coordinate fixed and all others at their optimum."""
    residuals = problem.residuals(vector)
    lowest = float(residuals @ residuals)
    for _ in range(FOLLOWING):
        vector = vector.copy()
        vector[others] -= follow @ residuals
        residuals = problem.residuals(vector)
        lowest = min(lowest, float(residuals @ residuals))
    return lowest


def _unbounded(nuisance: Nuisance, nominal: float, coordinate: float) -> float:
    if nuisance.kind == "added":
        return nominal + coordinate
    return nuisance.value(nominal, coordinate)
