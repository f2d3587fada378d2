"""Weights from the pulses that they weigh: the bias of that, and that it is taken off."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.training.moments import Values
from cpunet.training.optimal_weights import Parts, Sums, WeightedMeans, jackknife_bias

PARTS, IN_PART, FUNCTIONS = 10, 40, 40
# How the functions, whose means are 1, change with each of two coordinates: where by chance
# they are larger, they change more.
OFFSET = 0.7
CHANGES = np.stack([np.linspace(0.5, 1.5, FUNCTIONS), np.linspace(-1, 1, FUNCTIONS) ** 2], 1)
WIDE = np.full(2, 1e3)


def sums(values: Values) -> Sums:
    """Sums over simulated pulses, (pulses, functions), as the coordinates change them."""
    moved = (values - OFFSET).sum(axis=0)[:, np.newaxis] * CHANGES
    return Sums(len(values), values.sum(axis=0), values.T @ values, moved)


def sides(seed: int) -> tuple[list[Sums], list[Sums]]:
    """Both sides of one experiment in parts: skewed functions, as of bins with few pulses."""
    drawn = np.random.default_rng(seed).exponential(size=(2, PARTS, IN_PART, FUNCTIONS))
    return [sums(part) for part in drawn[0]], [Sums.of(part) for part in drawn[1]]


def estimate(means: WeightedMeans) -> Values:
    """Coordinates at which both sides agree; the true ones are 0."""
    return np.asarray(-np.linalg.solve(means.slopes, means.deviations))


def test_the_bias_of_weights_from_the_same_pulses_is_taken_off() -> None:
    found, left = [], []
    for seed in range(100):
        both = Parts(*sides(seed), PARTS * IN_PART / 2)
        found.append(estimate(both.whole))
        free = np.full(2, np.nan)
        left.append(found[-1] - jackknife_bias([both], np.zeros(2), WIDE, free))
    errors = np.std(found, axis=0) / np.sqrt(len(found))
    before, after = np.mean(found, axis=0), np.mean(left, axis=0)
    assert np.abs(before[0]) > 5 * errors[0]
    assert np.abs(after[0]) < 0.3 * np.abs(before[0])
    # not at the cost of much larger errors
    assert (np.std(left, axis=0) < 1.2 * np.std(found, axis=0)).all()


def test_weights_are_of_all_parts_or_all_but_one() -> None:
    simulated, measured = sides(1)
    both = Parts(simulated, measured, 200)
    rest = WeightedMeans(
        sum(simulated[1:], Sums()), sum(measured[1:], Sums()), 200 * (1 - 1 / PARTS)
    )
    np.testing.assert_allclose(both.without[0].weights, rest.weights)
    np.testing.assert_allclose(both.without[0].deviations, rest.deviations)
    everything = WeightedMeans(sum(simulated, Sums()), sum(measured, Sums()), 200)
    np.testing.assert_allclose(both.whole.slopes, everything.slopes)
    assert len(both.without) == PARTS


def test_means_and_covariances_are_those_of_the_pulses() -> None:
    values = np.random.default_rng(2).exponential(size=(50, 4))
    both = Sums.of(values[:20]) + Sums.of(values[20:])
    np.testing.assert_allclose(both.mean, values.mean(axis=0))
    np.testing.assert_allclose(both.covariance, np.cov(values.T, bias=True))


@pytest.mark.parametrize("held", [0, 1])
def test_what_is_held_has_no_bias(held: int) -> None:
    both = Parts(*sides(3), PARTS * IN_PART / 2)
    moves = np.full(2, np.nan)
    moves[held] = 0.01
    bias = jackknife_bias([both], np.zeros(2), WIDE, moves)
    assert bias[held] == 0
    assert bias[1 - held] != 0


def test_a_narrow_prior_leaves_no_bias() -> None:
    both = Parts(*sides(4), PARTS * IN_PART / 2)
    narrow = jackknife_bias([both], np.zeros(2), np.full(2, 1e-6), np.full(2, np.nan))
    wide = jackknife_bias([both], np.zeros(2), WIDE, np.full(2, np.nan))
    assert np.abs(narrow).max() < 1e-3 * np.abs(wide).max()
