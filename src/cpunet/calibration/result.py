"""What a search ended with, in the units of the parameters and in words."""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np

from cpunet.calibration.calibrated_run import (
    CalibratedPhysics,
    ChiSquare,
    FixedParameter,
    FreeParameter,
)
from cpunet.calibration.identifiability import Linear, together
from cpunet.calibration.joint_problem import JointProblem
from cpunet.calibration.nuisances import Values

# Number of prior errors beyond which a parameter is reported as unexpected.
FAR = 3.0
# Chi-square beyond chance, in its standard deviations, that is too much.
BEYOND_CHANCE = 4.0
# Advice where a parameter is unexpected, besides the general advice.
ADVICE = {
    "self_repulsion": "; it acts within each hit, so hits that are not merged within "
    "0.2 mm (cluster_mm), as tracks are long, need more of it"
}
# Minimum decrease of chi-square that is reported for a further parameter.
NOTABLE = 9.0


def described(
    problem: JointProblem,
    covariance: Values,
    chi: ChiSquare,
    linear: Linear,
    **facts: Any,
) -> CalibratedPhysics:
    """The calibrated physics in the units of their parameters.

    Parameters
    ----------
    problem
        Comparison at the end of the search: chain, coordinates, functions, pulses.
    covariance
        Covariance of its parameters, with errors of the functions larger by a scale.
    chi
        Chi-square of the functions, and this scale.
    linear
        Dependence of the functions on all physics.
    facts
        Further fields of `CalibratedPhysics`.
    """
    physics = problem.physics
    n, free, fixed, notes = problem.n_chain, {}, {}, []
    # free parameters: value and error in their own units, and whether these can be true
    centres, priors = physics.priors(problem.given)
    errors = np.sqrt(covariance.diagonal()[n:])
    # sampling noise makes those with all free larger, too
    errors_all = linear.errors()
    larger = errors / linear.errors(problem.free)
    off = (problem.vector()[n:] - problem.centre[n:]) / problem.widths[n:]
    ends = np.stack([problem.low, problem.high])[:, n:] == problem.vector()[n:]
    for k, i in enumerate(problem.free):
        nuisance, x = physics.nuisances[i], float(problem.coordinates[i])
        name, (low, high) = nuisance.name, nuisance.possible
        value, own_error = physics.in_own_unit(i, x, errors[k])
        doubt = f"{abs(off[k]):.1f} errors of its prior from it" if abs(off[k]) > FAR else None
        if not low <= value <= high:
            doubt = f"{low:g} to {high:g} is possible"
        if ends[:, k].any() and value != 0:  # none of it can be true
            doubt = "at its bound"
        if doubt:
            notes.append(
                f"the fit uses {name} = {value:.4g} to make up for something else ({doubt}): "
                "free what else moves pulses so, or give a `prior` if it can be"
                f"{ADVICE.get(name, '')}"
            )
        centre, width = physics.in_own_unit(i, float(centres[i]), priors[i])
        free[name] = FreeParameter(
            value=value,
            error=own_error,
            error_all=physics.in_own_unit(i, x, larger[k] * errors_all[i])[1],
            simulated=physics.nominal(nuisance),
            doubt=doubt,
            prior=centre,
            prior_error=width,
            source="given" if name in problem.given else nuisance.source,
        )
    # the others: what would be if they were free
    here, _ = linear.cost(problem.free)
    for i, nuisance in enumerate(physics.nuisances):
        if i not in problem.free:
            more = [*problem.free, i]
            error = chi.errors_scaled_by * linear.errors(more)[-1]
            value, own_error = physics.in_own_unit(i, float(problem.coordinates[i]), error)
            fall = here - linear.cost(more)[0]
            fixed[nuisance.name] = FixedParameter(
                value=value, chi_square_would_fall_by=fall, error_if_free=own_error
            )
    # how good the fit is
    per, mean, spread = (x / chi.moments for x in (chi.after, chi.expected, chi.spread))
    if per <= mean + BEYOND_CHANCE * spread:
        text = f"expected from statistics ({mean:.2f} ± {spread:.2f})"
        text += "" if notes else ": no other physics are needed"
    else:
        falls = {name: of.chi_square_would_fall_by for name, of in fixed.items()}
        best = max(falls, key=lambda name: falls[name], default="")
        rest = "none of the parameters looked at explains it"
        if best and falls[best] > NOTABLE:
            rest = f"with {best} free, too, it would fall by {falls[best]:.0f}"
        text = f"a poor fit (expected from statistics: {mean:.2f} ± {spread:.2f}); {rest}"
    groups = {group: names for of in problem.functions for group, names in of.names.items()}
    widths = problem.widths[n:]
    return CalibratedPhysics(
        parameters=free,
        fixed=fixed,
        together=together([*free], covariance[n:, n:] / np.outer(widths, widths), off),
        directions=linear.directions([nuisance.name for nuisance in physics.nuisances]),
        chi_square=chi,
        covariance=covariance[n:, n:].tolist(),
        functions=[*chain.from_iterable(groups.values())],
        groups={group: len(names) for group, names in groups.items()},
        notes=[*notes, f"chi-square is {per:.2f} per function, {text}"],
        **facts,
    )
