"""Bootstraps of events, against the direct bootstrap and the multinomial law."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from cpunet.pulses.binning import data_axis
from cpunet.validation import resampling
from cpunet.validation.comparisons import ceiling, iou, iou_error
from cpunet.validation.distances import (
    distance_errors,
    kolmogorov_smirnov,
    null_distances,
    wasserstein,
)
from cpunet.validation.resampling import Draws, Resampled, resampled_quantiles, resampled_twice

DRAWS = 400
WAYS = {"events": resampling.MAX_EVENTS, "bins": 0}  # what is drawn


def both_resampled(n_a: int, n_b: int, draws: int, seed: int) -> Draws:
    """Bootstraps of two sets, each of its own size."""
    rng = np.random.default_rng(seed)
    return Resampled.of(n_a, n_a, draws, rng), Resampled.of(n_b, n_b, draws, rng)


@pytest.fixture(params=WAYS.values(), ids=WAYS.keys())
def either_way(request, monkeypatch):
    monkeypatch.setattr(resampling, "MAX_EVENTS", request.param)


@pytest.mark.parametrize("size", [2, 50])
def test_histograms_of_the_draws_are_multinomial(size, either_way):
    bins = np.repeat([1, 2, 4], [1, 3, 6])
    found = Resampled.of(10, size, 20_000, np.random.default_rng(12)).counts(bins, 5)
    assert found.shape == (5, 20_000)
    assert set(found.sum(axis=0)) == {size}
    p = np.array([0, 1, 3, 0, 6]) / 10
    assert found.mean(axis=1) == pytest.approx(size * p, rel=0.03)
    covariance = size * (np.diag(p) - np.outer(p, p))
    assert np.cov(found) == pytest.approx(covariance, abs=0.03 * size)


def test_events_beyond_the_last_bin_are_drawn_and_not_counted(either_way):
    found = Resampled.of(4, 400, 500, np.random.default_rng(1)).counts(
        np.array([0, 1, 2, 2]), 2
    )
    assert found.sum(axis=0).mean() == pytest.approx(200, rel=0.02)
    assert found.sum(axis=0).std() == pytest.approx(10, rel=0.15)


def test_all_parameters_see_the_same_events():
    draws = Resampled.of(6, 6, 50, np.random.default_rng(2))
    bins = np.array([0, 1, 2, 2, 1, 0])
    np.testing.assert_array_equal(draws.counts(bins, 3)[::-1], draws.counts(2 - bins, 3))


@pytest.mark.thorough
def test_errors_and_nulls_are_those_of_the_direct_bootstrap(either_way):
    """Values drawn with replacement and scored one by one; some values are missing."""
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=700), rng.normal(0.2, 1.1, 900)
    a[:40], b[:20] = np.nan, np.inf
    axis = data_axis(a, 49)
    direct = {"w1": [], "ks": [], "iou": [], "w1 null": [], "ks null": [], "iou null": []}
    for _ in range(DRAWS):
        one, other = rng.choice(a, a.size), rng.choice(b, b.size)
        again = rng.choice(a, b.size)
        for name, second in (("", other), (" null", again)):
            direct["w1" + name].append(wasserstein(one, second))
            direct["ks" + name].append(kolmogorov_smirnov(one, second))
            direct["iou" + name].append(iou(one, second, axis))
    mean, std = ({k: f(v) for k, v in direct.items()} for f in (np.mean, np.std))

    draws = both_resampled(a.size, b.size, DRAWS, 4)
    w1, ks = distance_errors(a, b, draws)
    assert w1 == pytest.approx(std["w1"], rel=0.15)
    assert ks == pytest.approx(std["ks"], rel=0.15)
    assert iou_error(a, b, axis, draws) == pytest.approx(std["iou"], rel=0.15)
    pairs = resampled_twice(a.size, b.size, a.size, DRAWS, 5)
    null = null_distances(a, pairs)
    assert null.wasserstein == pytest.approx(mean["w1 null"], rel=0.06)
    assert null.wasserstein_std == pytest.approx(std["w1 null"], rel=0.15)
    assert null.ks == pytest.approx(mean["ks null"], rel=0.06)
    assert null.ks_std == pytest.approx(std["ks null"], rel=0.15)
    best, spread = ceiling(a, axis, pairs)
    assert best == pytest.approx(mean["iou null"], abs=0.4)
    assert spread == pytest.approx(std["iou null"], rel=0.15)


def test_draws_without_a_finite_value_are_left_out():
    rare = np.r_[1.0, np.full(99, np.nan)]
    some = np.array([1.0, 2.0])
    w1, ks = distance_errors(rare, some, both_resampled(100, 2, 200, 0))
    assert w1 == pytest.approx(0.5 / np.sqrt(2), rel=0.2)  # 0, ½ or 1, in ratios 1:2:1
    assert ks == pytest.approx(0.5 / np.sqrt(2), rel=0.2)
    few = both_resampled(100, 2, 1, 1)
    few[0].weights[0] = 0
    assert np.isnan(distance_errors(rare, some, few)).all()


@pytest.mark.parametrize(("n", "quantile"), [(20, 0.1), (37, 0.1), (300, 0.5), (25, 0.01)])
def test_quantiles_of_samples_are_those_of_the_direct_bootstrap(n, quantile):
    rng = np.random.default_rng(8)
    values = np.sort(np.r_[rng.exponential(size=n - 3), 7, 7, 7])
    drawn = rng.choice(values, (20_000, n))
    direct = np.quantile(drawn, quantile, axis=1, method="weibull")
    found = resampled_quantiles(values, quantile, 20_000, rng)
    assert found.std() == pytest.approx(direct.std(), rel=0.05)
    # equal but for rounding, where one lies between two of few values
    assert scipy.stats.ks_2samp(found.round(9), direct.round(9)).statistic < 0.02
