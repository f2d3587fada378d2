"""Least squares with errors, on a problem whose derivatives are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.training.levenberg_marquardt import levenberg_marquardt

TIMES = np.linspace(0.0, 2.0, 9)
TRUTH = np.array([3.0, 1.5])  # height and rate
PRIOR = 10.0  # width; so wide that it does not count
SIGMA = 0.05


class Vector:
    """Where the fit is, and how far it may go at once."""

    widths = np.full(2, PRIOR)

    def __init__(self, start: list[float]) -> None:
        self.now = np.array(start)

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

    def jacobian(self, vector: np.ndarray, residuals: np.ndarray) -> np.ndarray:
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
