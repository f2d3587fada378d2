"""Least squares with errors, on a problem whose derivatives are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from cpunet.training.levenberg_marquardt import descend, levenberg_marquardt

TIMES = np.linspace(0.0, 2.0, 9)
TRUTH = np.array([3.0, 1.5])  # height and rate
PRIOR = 10.0  # width; so wide that it does not count
SIGMA = 0.05


class Vector:
    """Where the fit is, and how far it may go."""

    def __init__(self, start: list[float], width: float = PRIOR) -> None:
        self.now, self.widths = np.array(start), np.full(len(start), width)
        self.longest = self.widths
        self.low, self.high = np.full(len(start), -np.inf), np.full(len(start), np.inf)

    def vector(self) -> np.ndarray:
        return self.now.copy()

    def set(self, vector: np.ndarray) -> None:
        self.now = vector.copy()


class Decay:
    """Points on a decaying exponential, measured with errors of one size."""

    clip: float | None = None
    moments = len(TIMES)

    def __init__(self, start: list[float]) -> None:
        self.parameters = Vector(start)
        self.centre = np.array(start)

    def residuals(self, vector: np.ndarray) -> np.ndarray:
        of, true = (v[0] * np.exp(-v[1] * TIMES) for v in (vector, TRUTH))
        return np.concatenate([(of - true) / SIGMA, (vector - self.centre) / PRIOR])

    def jacobian(self, vector: np.ndarray) -> np.ndarray:
        return derivatives(vector)


def derivatives(vector: np.ndarray) -> np.ndarray:
    decayed = np.exp(-vector[1] * TIMES)
    points = np.stack([decayed, -vector[0] * TIMES * decayed], axis=1) / SIGMA
    return np.concatenate([points, np.eye(2) / PRIOR])


@pytest.mark.parametrize("steps", [1, 30])  # the end by their number, and by convergence
@pytest.mark.parametrize("coarse", [False, True])
def test_the_covariance_is_that_where_the_fit_ends(steps: int, coarse: bool) -> None:
    problem = Decay([4.0, 1.0])
    found = levenberg_marquardt(problem, steps, None, coarse=coarse)
    slopes = derivatives(problem.parameters.now)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(slopes.T @ slopes), rtol=1e-9)


def test_the_truth_is_found_within_its_errors() -> None:
    problem = Decay([6.0, 0.5])
    found = levenberg_marquardt(problem, 30, None)
    apart = np.abs(problem.parameters.now - TRUTH)
    assert (apart < np.sqrt(found.covariance.diagonal())).all()
    assert found.cost < 0.3  # of which 0.1 is the prior's


@pytest.mark.parametrize(("low", "high"), [(1.6, 4.0), (0.1, 1.2)])
def test_a_fit_ends_at_a_bound_with_the_others_at_their_best(low: float, high: float) -> None:
    problem = Decay([4.0, high])
    problem.parameters.low[1], problem.parameters.high[1] = low, high
    found = levenberg_marquardt(problem, 30, None, coarse=False)
    bounds = ([-np.inf, low], [np.inf, high])
    known = least_squares(problem.residuals, [4.0, 0.5 * (low + high)], bounds=bounds)
    np.testing.assert_allclose(problem.parameters.now, known.x, rtol=1e-3)
    assert found.cost == pytest.approx(2 * known.cost, rel=1e-3)


@pytest.mark.parametrize("low", [0.1, 1.6])  # above the truth, too
def test_steps_with_known_derivatives_end_at_the_best_within_bounds(low: float) -> None:
    """Derivatives are those of another place; a first step of thrice the length leads up."""
    problem, bounds = Decay([3.0, 1.5]), (np.array([0.0, low]), np.array([9.0, 5.0]))
    known = least_squares(problem.residuals, [4.0, low + 0.1], bounds=bounds)
    near = known.x + np.array([0.1, 0.05])
    for factor in (1.0, 1 / 3):
        jacobian = factor * problem.jacobian(0.5 * (known.x + near))
        found, cost = descend(problem.residuals, near, jacobian, *bounds)
        np.testing.assert_allclose(found, known.x, atol=0.01)
        assert cost == pytest.approx(2 * known.cost, abs=0.05)


class Clipped:
    """A value that is the same for all numbers below 0, as physics at a bound are."""

    clip: float | None = None
    moments = 1

    def __init__(self, start: float, centre: float, width: float) -> None:
        self.parameters = Vector([start], width)
        self.centre = centre
        self.parameters.longest = np.maximum(width, np.abs(centre - self.parameters.now))
        self.parameters.low[:] = 0.0

    def residuals(self, vector: np.ndarray) -> np.ndarray:
        of, true = (np.exp(-3 * max(x, 0)) for x in (vector[0], 0.1))
        prior = (vector[0] - self.centre) / self.parameters.widths[0]
        return np.array([(of - true) / 0.01, prior])

    def jacobian(self, vector: np.ndarray) -> np.ndarray:
        moved = self.residuals(vector + 1e-6) - self.residuals(vector)
        return moved[:, np.newaxis] / 1e-6


def test_a_fit_whose_step_crosses_a_bound_comes_back() -> None:
    problem = Clipped(3.0, centre=0.0, width=PRIOR)
    levenberg_marquardt(problem, 30, None, coarse=False)
    assert problem.parameters.now[0] == pytest.approx(0.1, abs=0.01)


def test_a_prior_far_from_the_start_is_reached() -> None:
    """Its width limits steps near its centre only."""
    problem = Clipped(0.1, centre=2.0, width=1e-4)
    levenberg_marquardt(problem, 12, None, coarse=False)
    assert problem.parameters.now[0] == pytest.approx(2.0, abs=0.01)
