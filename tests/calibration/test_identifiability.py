"""What is told and what is degenerate, where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.calibration.identifiability import Linear, together
from cpunet.calibration.nuisances import named

NUISANCES = tuple(named(name) for name in ("temperature", "hole_velocity_low", "cloud"))
WIDTHS = np.array([n.prior for n in NUISANCES])
ROWS, ACTS = 200, 2


@pytest.fixture
def alike() -> Linear:
    """Temperature and velocity move functions alike, but for a little; the cloud none."""
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(2, 50))
    columns = [30 * one, 30 * one + 0.1 * other, np.zeros(50)]
    jacobian = np.concatenate([np.stack(columns, axis=1) / WIDTHS, np.diag(1 / WIDTHS)])
    return Linear(jacobian, np.zeros(53), np.zeros((2, 50)), np.zeros(3), WIDTHS, 1000.0)


def test_what_moves_pulses_alike_is_one_direction(alike):
    best, second, third = alike.directions([n.name for n in NUISANCES])
    assert best.error < 0.01
    assert best.components["temperature_K"] == pytest.approx(0.7, abs=0.05)
    assert best.components["hole_velocity_low_factor"] == pytest.approx(0.7, abs=0.05)
    assert second.error > 0.3
    assert second.components["temperature_K"] * second.components[
        "hole_velocity_low_factor"
    ] == pytest.approx(-0.5, abs=0.05)
    assert third.error == pytest.approx(1)
    assert third.components["cloud_fwhm_mm"] == pytest.approx(1)
    assert best.words.startswith("0.7")


@pytest.mark.parametrize(("correlation", "n"), [(-0.99, 1), (0.99, 1), (0.5, 0)])
def test_a_degenerate_pair_is_told_as_its_known_combination(correlation, n):
    covariance = np.eye(3)
    covariance[:2, :2] = 0.64 * np.array([[1, correlation], [correlation, 1]])
    covariance[2, 2] = 0.01
    found = together(["a", "b", "c"], covariance, np.zeros(3))
    assert len(found) == n
    for pair in found:
        combination = np.array([pair.components["a"], pair.components["b"], 0])
        assert combination @ covariance @ combination == pytest.approx(pair.error**2)
        assert pair.error == pytest.approx(0.8 * 0.1)
    # both known far better than before: two numbers
    assert not together(["a", "b"], 0.01 * covariance[:2, :2], np.zeros(2))


def selection(seed=0, size=6.0, begun=0.0) -> Linear:
    """A chain of one column, and four of physics, of which the third acts with a size."""
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(ROWS, 5)) / np.sqrt(ROWS)
    effect = size * columns[:, 1 + ACTS]
    # a half varies twice as much as all pulses, which are the mean of both halves
    halves = effect + np.sqrt(2) * rng.normal(size=(2, ROWS))
    weak = 1e-6 * np.eye(5)  # priors
    at = np.array([0.0, begun, 0.0, 0.0])
    residuals = np.concatenate([halves.mean(axis=0), np.zeros(5)])
    rows = np.concatenate([columns, weak])
    return Linear(rows, residuals, halves, at, np.full(5, 1e6), 1000.0)


def test_the_one_that_acts_describes_held_out_pulses_better():
    """On average by the fall of chi-square of all pulses, less the price of 2."""
    gains = np.array(
        [
            [one.score([]) - one.score([i]) for i in range(4)]
            for one in map(selection, range(200))
        ]
    )
    error = gains.std(axis=0) / np.sqrt(len(gains))
    expected = np.array([-2.0, -2.0, 36.0 - 2.0, -2.0])
    assert np.abs(gains.mean(axis=0) - expected) == pytest.approx(0, abs=0.1 * 36)
    assert (np.abs(gains.mean(axis=0) - expected)[[0, 1, 3]] < 4 * error[[0, 1, 3]]).all()


def test_costs_are_those_of_a_direct_fit():
    one = selection(begun=0.7)
    cost, there = one.cost([ACTS])
    # the one that had moved, and is not chosen, goes back to where it was simulated
    begun = one.residuals - 0.7 * one.jacobian[:, 2]
    columns = one.jacobian[:, [0, 1 + ACTS]]
    move = np.linalg.lstsq(columns, -begun)[0]
    assert cost == pytest.approx(float(np.sum((begun + columns @ move) ** 2)))
    assert there == pytest.approx([0, 0, move[1], 0])


def test_what_is_told_begins_with_what_held_out_pulses_need():
    """Of two parameters that act alike, only the first taken is determined."""
    nuisances = tuple(named(name) for name in ("temperature", "hole_velocity_low"))
    widths = np.array([n.prior for n in nuisances])
    rng = np.random.default_rng(2)
    common, other = rng.normal(size=(2, ROWS))
    # alike, but the second one describes the pulses
    columns = np.stack([common, common + 0.05 * other], axis=1)
    deviation = 30 * columns[:, 1]
    halves = deviation + rng.normal(size=(2, ROWS))
    rows = np.concatenate([columns / widths, np.diag(1 / widths)])
    residuals = np.concatenate([halves.mean(axis=0), np.zeros(2)])
    assert Linear(rows, residuals, halves, np.zeros(2), widths, 1.0).begin() == [1]
