"""Least squares by the Levenberg–Marquardt method, with errors and pulls."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from cpunet.errors import CpunetError
from cpunet.training.response_problem import ResponseProblem

Listener = Callable[[int, float], None]

# Far from the data all deviations would be clipped alike, so that first rounds clip later.
FIRST_CLIPS, ROUNDS_EACH = (64.0, 16.0), 4
# Fall of chi-square, in units of chi-square per moment, with which a fit ends: a few tenths
# of a standard deviation along the worst-known direction.
CONVERGED = 0.2
DAMPING, HARDER, EASIER, TRIES = 0.01, 6.0, 6.0, 6


@dataclass(frozen=True)
class Fit:
    """How well a response describes the data.

    Parameters
    ----------
    chi_square, moments
        Of the comparison, and the number of moments compared; before errors of the
        simulation were allowed for, if they were.
    steps
        Steps taken.
    errors
        Standard deviations of the parameters, by name, as the curvature where the fit ended
        gives them.
    pulls
        Deviation of each moment in its standard deviations, by name.
    data_left_out
        Measured pulses that the moments leave out: a second pulse, or no baseline.
    """

    chi_square: float
    moments: int
    steps: int
    errors: dict[str, float]
    pulls: dict[str, float]
    data_left_out: int


def levenberg_marquardt(
    problem: ResponseProblem, steps: int, listener: Listener | None, *, coarse: bool = True
) -> Fit:
    """Minimise a problem from where its response is, and leave the response there.

    Parameters
    ----------
    problem
        With the parameters to be found.
    steps
        The most there may be.
    listener
        Told step and chi-square.
    coarse
        Whether it begins far from the data.

    Raises
    ------
    CpunetError
        If chi-square is not finite in the end.
    """
    vector, taken = problem.vector(), 0
    rounds = [(clip, ROUNDS_EACH) for clip in FIRST_CLIPS if coarse]
    for clip, most in [*rounds, (None, steps - ROUNDS_EACH * len(rounds))]:
        problem.clip = clip
        residuals, damping = problem.residuals(vector), DAMPING
        cost = float(residuals @ residuals)
        for _ in range(max(1, most)):
            jacobian = problem.jacobian(vector, residuals)
            curvature, gradient = jacobian.T @ jacobian, jacobian.T @ residuals
            for _ in range(TRIES):
                scaled = curvature + damping * torch.diag(curvature.diagonal())
                move = -torch.linalg.solve(scaled, gradient)
                tried = vector + move.clamp(-problem.widths, problem.widths)
                found = problem.residuals(tried)
                if float(found @ found) < cost:
                    break
                damping *= HARDER
            else:
                break
            fall = cost - float(found @ found)
            vector, residuals, cost = tried, found, cost - fall
            damping /= EASIER
            taken += 1
            if listener is not None:
                listener(taken, cost)
            if fall < CONVERGED * max(1.0, cost / len(problem.wanted)):
                break
    if not math.isfinite(cost):
        raise CpunetError(
            "the fit of the response diverged; check that the sets hold single pulses of one "
            "detector (cpunet info), or train on other energies (--peak)"
        )
    # the last curvature may be that before the last step, which can be a long one
    jacobian = problem.jacobian(vector, residuals)
    covariance = torch.linalg.inv(jacobian.T @ jacobian)
    problem.set(vector)
    pulls = problem.pulls(vector)
    return Fit(
        chi_square=cost,
        moments=len(pulls),
        steps=taken,
        errors=_by_name(problem.labels, covariance.diagonal().sqrt()),
        pulls=dict(zip(problem.moments.names, pulls.tolist(), strict=True)),
        data_left_out=problem.moments.left_out,
    )


def _by_name(labels: list[str], values: Tensor) -> dict[str, float]:
    counted: dict[str, int] = {}
    named = {}
    for label, value in zip(labels, values.tolist(), strict=True):
        counted[label] = counted.get(label, 0) + 1
        named[f"{label}.{counted[label]}"] = value
    return named
