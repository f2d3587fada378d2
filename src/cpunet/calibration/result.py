"""Results of a calibration as plain numbers for storage and figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from cpunet.calibration.joint_problem import JointProblem
from cpunet.calibration.nuisances import Nuisance, Values, known_before
from cpunet.calibration.other_chains import BEYOND_CHANCE
from cpunet.calibration.search import Calibrated

# Offsets of a profile in errors, and steps in which the other parameters are minimised.
OFFSETS, FOLLOWING = (-2.0, -1.0, 0.0, 1.0, 2.0), 2
# Number of prior errors beyond which a parameter is reported as unexpected.
FAR = 3.0
# Chi-square per moment beyond which the physics does not describe the data at all.
HOPELESS = 50.0
# Advice where a parameter is unexpected, besides the general one.
ADVICE = {
    "self_repulsion": "it acts within each hit, so hits that are not merged within "
    "0.2 mm (cluster_mm), as tracks are long, need more of it"
}
# Minimum decrease of chi-square that is reported for a further parameter.
WORTH_TELLING = 9.0


def described(calibrated: Calibrated) -> dict[str, Any]:
    """Content of ``calibration.json``.

    Returns
    -------
    dict
        ``parameters``: value, error (with the parameters below as simulated), error_all (with
        all parameters considered free), simulated value and prior of each free parameter;
        ``fixed``: parameters considered but kept as simulated, and the decrease of chi-square
        expected if they were free; ``chi_square``; ``directions``; ``covariance`` of chain and
        coordinates; ``pulls`` of the functions, before and after; ``profiles``; ``notes``.
    """
    problem = calibrated.problem
    vector = problem.parameters.vector()
    physics = problem.nearby.simulator.physics
    values = physics.values(problem.parameters.coordinates)
    mean, spread = problem.by_chance
    return {
        "parameters": _parameters(calibrated),
        "fixed": {
            name: {"value": values[name], "chi_square_would_fall_by": fall}
            for name, fall in calibrated.promised.items()
        },
        "chi_square": {
            "before": calibrated.chi_square_before,
            "after": calibrated.chi_square,
            "moments": problem.moments,
            "degrees_of_freedom": problem.moments - len(vector),
            "by_chance": {"mean": mean, "standard_deviation": spread},
            "errors_scaled_by": calibrated.scale,
        },
        "directions": [direction.describe() for direction in calibrated.directions],
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
    parameters, physics = problem.parameters, problem.nearby.simulator.physics
    values = physics.values(parameters.coordinates)
    found = []
    vector, n = parameters.vector(), parameters.n_chain
    for k, i in enumerate(parameters.free):
        nuisance = physics.nuisances[i]
        value, name = values[nuisance.name], nuisance.name
        if vector[n + k] in (parameters.low[n + k], parameters.high[n + k]):
            found.append(f"{name} is at its bound, {value:g}: fix it, or free another")
        width = parameters.widths[n + k]
        off = (vector[n + k] - parameters.centre[n + k]) / width
        if abs(off) > FAR:
            found.append(
                f"{name} = {value:.4g} is {abs(off):.1f} errors of its prior from it: give a "
                "wider prior if that is possible, or free what else moves pulses so"
                + (f"; {ADVICE[name]}" if name in ADVICE else "")
            )
    per = calibrated.chi_square / problem.moments
    asked = {k: v for k, v in calibrated.promised.items() if v > WORTH_TELLING}
    best = max(asked, key=lambda name: asked[name], default=None)
    mean, spread = (number / problem.moments for number in problem.by_chance)
    if per <= mean + BEYOND_CHANCE * spread:
        found.append(
            f"chi-square is {per:.2f} per function, as by chance ({mean:.2f} ± {spread:.2f}): "
            "no other physics are needed"
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


def hopeless(calibrated: Calibrated) -> bool:
    """Whether the data clearly belong to another detector."""
    return calibrated.chi_square > HOPELESS * calibrated.problem.moments


def _parameters(calibrated: Calibrated) -> dict[str, Any]:
    """Value, errors, simulated value and prior of each free parameter, by name."""
    problem = calibrated.problem
    parameters, physics = problem.parameters, problem.nearby.simulator.physics
    values = physics.values(parameters.coordinates)
    before = known_before(physics, parameters.given)
    free = {}
    for i, error in zip(parameters.free, calibrated.errors, strict=True):
        nuisance = physics.nuisances[i]
        nominal, value = physics.nominal(nuisance), values[nuisance.name]
        slope = nuisance.slope(nominal, value)
        centre, width = before[nuisance.name]
        free[nuisance.name] = {
            "value": value,
            "error": float(slope * error),
            "error_all": slope * calibrated.errors_all[nuisance.name],
            "simulated": nominal,
            "prior": {
                "value": centre,
                "error": width,
                "source": "given" if nuisance.name in parameters.given else nuisance.source,
            },
        }
    return free


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
