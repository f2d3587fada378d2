r"""What a search ended with, in the units of the parameters and in words.

Deviations :math:`r` and derivatives :math:`J` are means over the same simulated events, so
their sampling errors go together. At the true parameters the mean of :math:`J^T r` is then not
zero but some :math:`N_r`, and :math:`J^T J` is too large by the noise :math:`N_J` of the
derivatives: along weak directions a fit is biased, and its errors are too small (statisticians
call it the problem of many weak instruments). The spread between parts of the events tells
both. With priors :math:`P` and :math:`H = J^T J - N_J + P`, a fit is moved by
:math:`H^{-1} N_r`, and its covariance is :math:`H^{-1} (J^T J + P) H^{-1}`.

The weights have sampling errors, too: they are the inverse covariance of :math:`d` functions,
from :math:`n` pulses. They scatter :math:`p` parameters further, and make errors too small: the
covariance's :math:`J^T J`, but not its :math:`P`, grows by a factor (Dodelson and Schneider,
Phys. Rev. D 88 (2013) 063537; Percival et al., MNRAS 439 (2014) 2531).
"""

from __future__ import annotations

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


# Largest share of the information along a direction that is taken for noise: the parts of the
# events do not determine a larger share well enough.
MOST = 0.9


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
    centres, priors = physics.priors()
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
            source="given" if name in physics.given else nuisance.source,
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
    widths = problem.widths[n:]
    return CalibratedPhysics(
        parameters=free,
        fixed=fixed,
        together=together([*free], covariance[n:, n:] / np.outer(widths, widths), off),
        directions=linear.directions([nuisance.name for nuisance in physics.nuisances]),
        chi_square=chi,
        covariance=covariance[n:, n:].tolist(),
        groups={group: n for of in problem.functions for group, n in of.groups.items()},
        notes=[*notes, f"chi-square is {per:.2f} per function, {text}"],
        **facts,
    )


def of_parts(
    jacobian: Values, slopes: Values, deviations: Values, factor: float = 1.0
) -> tuple[Values, Values]:
    """Move of fitted parameters without sampling noise, and their covariance.

    Parameters
    ----------
    jacobian
        Derivatives of all residuals and priors, shape (residuals, parameters); those of means
        over events first.
    slopes
        Derivatives of the residuals that are means over events, from each of several equal
        parts of the events, shape (parts, means, parameters).
    deviations
        These residuals from each part, shape (parts, means).
    factor
        Of the variances that these residuals have, but not the priors.
    """
    parts = len(slopes)
    slopes, deviations = slopes - slopes.mean(axis=0), deviations - deviations.mean(axis=0)
    noise = np.einsum("kij,kil->jl", slopes, slopes) / (parts * (parts - 1))
    gradient = np.einsum("kij,ki->j", slopes, deviations) / (parts * (parts - 1))
    means, whole = jacobian[: slopes.shape[1]], jacobian.T @ jacobian
    inverse = np.linalg.inv(np.linalg.cholesky(whole))
    share, axes = np.linalg.eigh(inverse @ noise @ inverse.T)
    root, back = inverse.T @ axes / (1 - np.minimum(share, MOST)), axes.T @ inverse
    solve = root @ back  # the inverse of H
    covariance = solve @ (whole + (factor - 1) * means.T @ means) @ solve.T
    return solve @ gradient, covariance


def of_weights(n: float, d: float, p: int) -> float:
    """Factor of the variances of `p` parameters if `d` functions are weighted by `n` pulses.

    Examples
    --------
    >>> [round(of_weights(n, 86, 16), 2) for n in (950, 10_000)]
    [1.19, 1.02]
    """
    return n / (n - d) * (1 + max(0.0, d - p) / (n - d))
