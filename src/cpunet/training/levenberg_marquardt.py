"""Least squares within bounds: Levenberg–Marquardt, and steps with known derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import scipy.optimize

from cpunet.errors import CpunetError
from cpunet.training.moments import Values

Tell = Callable[[float], None]

# Far from the data all deviations would be clipped, so the first rounds have wider clips.
FIRST_CLIPS, ROUNDS_EACH = (64.0, 16.0), 4
# Decrease of chi-square, in units of chi-square per moment, below which a fit ends: a few
# tenths of a standard deviation along the worst-known direction.
CONVERGED = 0.2
DAMPING, DAMPING_UP, DAMPING_DOWN, TRIES = 0.01, 6.0, 6.0, 6
UNDAMPED = 1e-6  # for the last step
UPDATES = 2  # steps between evaluations of the derivatives, which are only updated meanwhile


class Unknowns(Protocol):
    """Free parameters as a vector, with widths of priors, longest steps, and bounds."""

    widths: Values
    longest: Values
    low: Values
    high: Values

    def vector(self) -> Values: ...

    def set(self, vector: Values) -> None: ...


class Problem(Protocol):
    """Residuals whose sum of squares is to be minimised."""

    clip: float | None

    @property
    def parameters(self) -> Unknowns: ...

    @property
    def moments(self) -> int: ...

    def residuals(self, vector: Values) -> Values: ...

    def jacobian(self, vector: Values) -> Values: ...


class Minimum(NamedTuple):
    """Result of a fit.

    Parameters
    ----------
    cost
        Sum of the squared residuals.
    covariance
        Covariance of the parameters.
    """

    cost: float
    covariance: Values


def levenberg_marquardt(
    problem: Problem, steps: int, tell: Tell | None, *, coarse: bool = True
) -> Minimum:
    r"""Minimise a problem from its current parameters, and set them to the minimum.

    With residuals :math:`r`, their derivatives :math:`J` and a damping :math:`\lambda`, steps
    are

    .. math:: \delta = -\left[J^T J + \lambda\, \mathrm{diag}(J^T J)\right]^{-1} J^T r

    (Marquardt, J. SIAM 11 (1963) 431), and the covariance is :math:`(J^T J)^{-1}`.

    Parameters
    ----------
    problem
        Problem with the parameters to be found.
    steps
        Maximum number of steps.
    tell
        Called with chi-square after each step.
    coarse
        Whether the start is far from the data.

    Raises
    ------
    CpunetError
        If chi-square is not finite at the end.
    """
    parameters = problem.parameters
    vector = parameters.vector()
    rounds = [(clip, ROUNDS_EACH) for clip in FIRST_CLIPS if coarse]
    for clip, most in [*rounds, (None, steps - ROUNDS_EACH * len(rounds))]:
        problem.clip = clip
        residuals, damping = problem.residuals(vector), DAMPING
        cost = float(residuals @ residuals)
        jacobian, updates, stalled = problem.jacobian(vector), 0, False
        for _ in range(max(1, most)):
            fresh = not updates
            converged = fresh and _gain(parameters, vector, jacobian, residuals) < CONVERGED
            step = _step(
                problem, jacobian, vector, residuals, UNDAMPED if converged else damping
            )
            if step is None and not fresh:
                # the derivatives may be outdated
                jacobian, updates, fresh = problem.jacobian(vector), 0, True
                step = _step(problem, jacobian, vector, residuals, damping)
            if step is None:
                break
            tried, found, damping = step
            before, cost = cost, float(found @ found)
            small = before - cost < CONVERGED * max(1.0, cost / problem.moments)
            converged = converged or (small and fresh and stalled)
            stalled = small and fresh
            if converged:
                updates += 1  # the derivatives are those before this step
            elif small or updates == UPDATES:
                jacobian, updates = problem.jacobian(tried), 0
            else:
                # Broyden's update: correct the derivatives by the change in this step
                way = (tried - vector) / parameters.widths
                change = found - residuals - jacobian @ (tried - vector)
                jacobian = jacobian + np.outer(change, way / parameters.widths) / (way @ way)
                updates += 1
            vector, residuals = tried, found
            if tell is not None:
                tell(cost)
            if converged:
                break
    if not math.isfinite(cost):
        raise CpunetError(
            "the fit of the response diverged; check that the sets hold single pulses of one "
            "detector (cpunet info), or train on other energies (`peak`)"
        )
    if updates:  # the last derivatives are those before some step
        jacobian = problem.jacobian(vector)
    parameters.set(vector)
    covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian), float)
    return Minimum(cost, covariance)


def _step(
    problem: Problem, jacobian: Values, vector: Values, residuals: Values, damping: float
) -> tuple[Values, Values, float] | None:
    """Vector with a lower cost, its residuals, and the next damping; None if none is found."""
    parameters, cost = problem.parameters, residuals @ residuals
    longest = parameters.longest
    curvature, gradient = jacobian.T @ jacobian, jacobian.T @ residuals
    for _ in range(TRIES):
        scaled = curvature + damping * np.diag(curvature.diagonal())
        move = np.clip(_within(parameters, vector, scaled, gradient), -longest, longest)
        tried = np.clip(vector + move, parameters.low, parameters.high)
        found = problem.residuals(tried)
        if found @ found < cost:
            return tried, found, damping / DAMPING_DOWN
        damping *= DAMPING_UP
    return None


def _gain(parameters: Unknowns, vector: Values, jacobian: Values, residuals: Values) -> float:
    """Decrease of chi-square by a full step if the residuals were linear."""
    gradient = jacobian.T @ residuals
    return -float(gradient @ _within(parameters, vector, jacobian.T @ jacobian, gradient))


def _within(
    parameters: Unknowns, vector: Values, curvature: Values, gradient: Values
) -> Values:
    """Return the step to the minimum of a parabola; parameters at a bound do not cross it.

    The others move as if those were fixed. Beyond a bound a parameter has no derivative, and a
    fit that stepped there could not return.
    """
    low, high = vector <= parameters.low, vector >= parameters.high
    free = np.ones(len(vector), dtype=bool)
    move = np.zeros(len(vector))
    while free.any():
        move[:] = 0
        move[free] = -np.linalg.solve(curvature[np.ix_(free, free)], gradient[free])
        out = (low & (move < 0)) | (high & (move > 0))
        if not out.any():
            break
        free &= ~out
    return np.where(free, move, 0.0)


# Steps with known derivatives, at most, and the fall of the sum of squares below which they
# end. Bounds are wider by the last number: for the solver, they must not coincide.
KNOWN_STEPS, FLAT, AT_BOUND = 8, 0.02, 1e-9


def descend(
    residuals: Callable[[Values], Values],
    vector: Values,
    jacobian: Values,
    low: Values,
    high: Values,
) -> tuple[Values, float]:
    """Minimise residuals whose derivatives are known nearby and hold here, too, within bounds.

    Steps that lead up are halved.

    Returns
    -------
    tuple
        Where the minimum is, and the sum of the squared residuals there.
    """
    vector = np.clip(vector, low, high)
    left, share = residuals(vector), 1.0
    for _ in range(KNOWN_STEPS):
        bounds = low - vector - AT_BOUND, high - vector + AT_BOUND
        step = scipy.optimize.lsq_linear(jacobian, -left, bounds, method="bvls").x
        tried = np.clip(vector + share * step, low, high)
        found = residuals(tried)
        fall = float(left @ left - found @ found)
        if fall <= 0:
            share *= 0.5
            continue
        vector, left = tried, found
        if fall < FLAT:
            break
    return vector, float(left @ left)
