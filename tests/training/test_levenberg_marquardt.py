"""Least squares with errors, on a problem whose derivatives are known in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from cpunet.training.levenberg_marquardt import levenberg_marquardt

TIMES = torch.linspace(0.0, 2.0, 9, dtype=torch.float64)
TRUTH = torch.tensor([3.0, 1.5], dtype=torch.float64)  # height and rate
PRIOR = 10.0  # width; so wide that it does not count
SIGMA = 0.05


class Decay:
    """Points on a decaying exponential, measured with errors of one size."""

    clip: float | None = None
    labels = ("height", "rate")
    widths = torch.full((2,), PRIOR, dtype=torch.float64)
    wanted = TIMES
    moments = SimpleNamespace(names=tuple(f"point {i}" for i in range(9)), left_out=0)

    def __init__(self, start: list[float]) -> None:
        self.now = self.centre = torch.tensor(start, dtype=torch.float64)

    def vector(self) -> Tensor:
        return self.now.clone()

    def set(self, vector: Tensor) -> None:
        self.now = vector.clone()

    def pulls(self, vector: Tensor) -> Tensor:
        of, true = (v[0] * torch.exp(-v[1] * TIMES) for v in (vector, TRUTH))
        return (of - true) / SIGMA

    def residuals(self, vector: Tensor) -> Tensor:
        return torch.cat([self.pulls(vector), (vector - self.centre) / PRIOR])

    def jacobian(self, vector: Tensor, residuals: Tensor) -> Tensor:
        return derivatives(vector)


def derivatives(vector: Tensor) -> Tensor:
    decayed = torch.exp(-vector[1] * TIMES)
    points = torch.stack([decayed, -vector[0] * TIMES * decayed], dim=1) / SIGMA
    return torch.cat([points, torch.eye(2, dtype=torch.float64) / PRIOR])


@pytest.mark.parametrize("steps", [1, 30])  # the end by their number, and by convergence
@pytest.mark.parametrize("coarse", [False, True])
def test_errors_are_those_where_the_fit_ends(steps: int, coarse: bool) -> None:
    problem = Decay([4.0, 1.0])
    fit = levenberg_marquardt(problem, steps, None, coarse=coarse)
    slopes = derivatives(problem.now)
    expected = torch.linalg.inv(slopes.T @ slopes).diagonal().sqrt()
    assert fit.errors == pytest.approx(
        {"height.1": float(expected[0]), "rate.1": float(expected[1])}, rel=1e-9
    )


def test_the_truth_is_found_within_its_errors() -> None:
    problem = Decay([6.0, 0.5])
    fit = levenberg_marquardt(problem, 30, None)
    apart = (problem.now - TRUTH).abs().tolist()
    assert apart[0] < fit.errors["height.1"]
    assert apart[1] < fit.errors["rate.1"]
    assert fit.chi_square < 0.1
