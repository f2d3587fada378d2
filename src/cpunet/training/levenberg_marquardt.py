"""Least squares by the Levenberg–Marquardt method, with errors and pulls."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from cpunet.errors import CpunetError
from cpunet.training.moments import Values
from cpunet.training.response_problem import Parameters

Listener = Callable[[int, float], None]

# Far from the data all deviations would be clipped alike, so that first rounds clip later.
FIRST_CLIPS, ROUNDS_EACH = (64.0, 16.0), 4
# Fall of chi-square, in units of chi-square per moment, with which a fit ends: a few tenths
# of a standard deviation along the worst-known direction.
CONVERGED = 0.2
DAMPING, HARDER, EASIER, TRIES = 0.01, 6.0, 6.0, 6


class Problem(Protocol):
    """Residuals whose squares are to be as small as possible in all."""

    clip: float | None

    @property
    def parameters(self) -> Parameters: ...

    @property
    def moments(self) -> int: ...

    def residuals(self, vector: Values) -> Values: ...

    def jacobian(self, vector: Values, residuals: Values) -> Values: ...


class Minimum(NamedTuple):
    """Where a fit has ended.

    Parameters
    ----------
    cost
        Sum of the squared residuals.
    steps
        Taken.
    covariance
        Of the parameters.
    """

    cost: float
    steps: int
    covariance: Values


def levenberg_marquardt(
    problem: Problem, steps: int, listener: Listener | None, *, coarse: bool = True
) -> Minimum:
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
    parameters = problem.parameters
    vector, taken = parameters.vector(), 0
    rounds = [(clip, ROUNDS_EACH) for clip in FIRST_CLIPS if coarse]
    for clip, most in [*rounds, (None, steps - ROUNDS_EACH * len(rounds))]:
        problem.clip = clip
        residuals, damping = problem.residuals(vector), DAMPING
        cost = float(residuals @ residuals)
        for _ in range(max(1, most)):
            jacobian = problem.jacobian(vector, residuals)
            curvature, gradient = jacobian.T @ jacobian, jacobian.T @ residuals
            for _ in range(TRIES):
                scaled = curvature + damping * np.diag(curvature.diagonal())
                move = -np.linalg.solve(scaled, gradient)
                tried = vector + np.clip(move, -parameters.widths, parameters.widths)
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
            if fall < CONVERGED * max(1.0, cost / problem.moments):
                break
    if not math.isfinite(cost):
        raise CpunetError(
            "the fit of the response diverged; check that the sets hold single pulses of one "
            "detector (cpunet info), or train on other energies (--peak)"
        )
    # the last curvature may be that before the last step, which can be a long one
    jacobian = problem.jacobian(vector, residuals)
    parameters.set(vector)
    covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian), float)
    return Minimum(cost, taken, covariance)
