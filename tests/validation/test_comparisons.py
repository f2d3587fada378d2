"""Overlap of distributions, and bootstraps: nothing is dropped, errors are the direct ones."""

from __future__ import annotations

import hist
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cpunet.pulses.shape_parameters import data_axis
from cpunet.validation import comparisons
from cpunet.validation.comparisons import (
    NODES,
    NULL_NODES,
    Resampled,
    compare,
    drawn_distances,
    histogram,
    overlap,
    wasserstein,
)
from synthetic import load_recipe

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 50})
UNIT = hist.axis.Regular(10, 0.0, 1.0)

any_floats = arrays(
    float,
    st.integers(1, 60),
    elements=st.one_of(st.floats(-1e6, 1e6), st.just(np.nan), st.just(np.inf)),
)


def iou(a, b, axis, draws=(None, None)) -> np.ndarray:
    """IoU of two sets, or of their bootstraps."""
    return overlap(*(histogram(v, axis, of) for v, of in zip((a, b), draws, strict=True)))


def resampled(events, sizes, draws: int, seed) -> list[Resampled]:
    """Bootstraps of two sets of so many events, each of its own size."""
    rng = np.random.default_rng(seed)
    return [Resampled(n, size, draws, rng) for n, size in zip(events, sizes, strict=True)]


def test_range_comes_from_the_bulk_of_the_data():
    clean = np.random.default_rng(0).normal(5, 1, 5000)
    axis = data_axis(clean, 49)
    spoiled = data_axis(np.r_[clean, [1e12] * 20, -1e12, np.inf, np.nan], 49)
    assert spoiled.size == pytest.approx(axis.size, abs=6)
    assert -1 < spoiled.edges[0] < clean.min() + 0.1
    assert clean.max() - 0.1 < spoiled.edges[-1] < 11
    for n in (100, 1000, 3000):  # bins are those of Freedman and Diaconis
        width = np.diff(data_axis(np.linspace(0, 1, n), 49).edges)[0]
        assert width == pytest.approx(2 * 0.5 / np.cbrt(n), rel=0.1)


@given(a=any_floats, b=any_floats)
def test_any_data_can_be_binned_and_every_event_is_counted(a, b):
    score = iou(a, b, UNIT)
    assert 0 <= score <= 100 + 1e-9
    assert score == pytest.approx(iou(b, a, UNIT))
    if np.isfinite(a).any():
        axis = data_axis(a, 49)
        assert 1 <= axis.size <= 49
        assert histogram(a, axis).sum() == len(a)
        assert iou(a, a, axis) == pytest.approx(100)


@pytest.mark.parametrize(
    ("low", "high"), [(0, 1), (-20, -0.1), (-1, 1e-9), (-3, 0), (-12, 5), (1e9, 1e9 + 1)]
)
def test_the_largest_value_is_no_overflow(low, high):
    rng = np.random.default_rng(0)
    for data in (np.linspace(low, high, 11), *rng.uniform(low, high, (200, 100))):
        assert histogram(data, data_axis(data, 49))[-2:].tolist() == [0, 0]


def test_no_event_is_dropped_from_an_iou():
    inside, numbers, nans = np.full(10, 0.55), np.full(10, 0.5), np.full(10, np.nan)
    # with density histograms these would score 100 %
    assert iou(inside, np.r_[0.55, np.full(9, 5.0)], UNIT) == pytest.approx(100 * 0.1 / 1.9)
    assert iou(inside, np.full(3, -5.0), UNIT) == 0
    assert iou(np.full(3, -5.0), np.full(3, 5.0), UNIT) == 0
    # nor are NaNs a match for numbers or for the overflow
    assert iou(numbers, nans, UNIT) == iou(np.full(10, 99.0), nans, UNIT) == 0
    assert iou(numbers, np.r_[numbers, nans], UNIT) == pytest.approx(100 * 0.5 / 1.5)


def test_without_values_there_is_no_score():
    empty, nothing, some = np.array([]), np.array([np.nan]), np.array([1.0, 2.0])
    assert np.isnan(iou(empty, some, UNIT))
    assert np.isnan(wasserstein(empty, some))
    assert np.isnan(iou(empty, some, UNIT, resampled((0, 2), (0, 2), 5, 0))).all()
    for *both, sizes in (
        (nothing, some, (1, 2)),
        (nothing, nothing, (5, 5)),
        (some, some, (0, 5)),
    ):
        draws = resampled(map(len, both), sizes, 5, 0)
        assert np.isnan(drawn_distances(*both, draws, NODES)).all()


def peak_with_tail(rng: np.random.Generator, n: int) -> np.ndarray:
    """A line with a tail below, as the current amplitude of an escape peak has it."""
    in_peak = rng.random(n) < 0.6
    return np.where(in_peak, rng.normal(0, 0.3, n), -3 * rng.exponential(size=n))


SHAPES = {
    "normal": lambda rng, n: rng.normal(size=n),
    "exponential": lambda rng, n: rng.exponential(size=n),
    "peak-with-tail": peak_with_tail,
}


@pytest.mark.parametrize("shape", SHAPES)
def test_two_samples_of_one_distribution_are_rarely_beyond_two_sigma(shape):
    """Over many draws: 2.3 % of a normal law, more of skewed ones; 0.5 … 9 % here."""
    rng = np.random.default_rng(6)
    n_data, n_sim = 300, 350
    z = {"iou": [], "w1": []}
    for _ in range(150):
        data, sim = SHAPES[shape](rng, n_data), SHAPES[shape](rng, n_sim)
        axis = data_axis(data, 49)
        pairs = resampled((n_data, n_data), (n_sim, n_data), 80, rng)
        ceiling = iou(data, data, axis, pairs)
        null = drawn_distances(data, data, pairs, NULL_NODES)
        z["iou"].append((ceiling.mean() - iou(data, sim, axis)) / ceiling.std())
        z["w1"].append((wasserstein(data, sim) - null.mean()) / null.std())
    for name, values in z.items():
        values = np.array(values)
        assert 0.005 <= (values > 2).mean() <= 0.09, name
        assert (values < -3).mean() == 0, name
        # the expectation is that of fresh samples within a third of the spread
        assert abs(values.mean()) < 0.33, name
        assert values.std() == pytest.approx(1, abs=0.2), name


@pytest.fixture(params=[comparisons.MAX_EVENTS, 0], ids=["events", "bins"])
def either_way(request, monkeypatch):
    """Events are drawn, or the contents of bins."""
    monkeypatch.setattr(comparisons, "MAX_EVENTS", request.param)


def test_errors_of_scores_are_the_scatter_of_fresh_samples(either_way):
    """Some values are missing."""
    rng = np.random.default_rng(7)
    found, errors = [], []
    axis = data_axis(rng.normal(size=500), 49)
    for draw in range(150):
        a, b = rng.normal(size=500), rng.normal(0.5, 1.2, 600)
        a[:25], b[:10] = np.nan, np.inf
        found.append((wasserstein(a, b), iou(a, b, axis)))
        draws = resampled((500, 600), (500, 600), 50, draw)
        spread = drawn_distances(a, b, draws, NODES), iou(a, b, axis, draws)
        errors.append([drawn.std() for drawn in spread])
    assert np.mean(errors, axis=0) == pytest.approx(np.std(found, axis=0), rel=0.2)


def distance_of(values: np.ndarray, *weights: np.ndarray) -> float:
    """Distance of two samples of values, in each of which they occur so often."""
    draws = resampled([0, 0], [int(w.sum()) for w in weights], 1, 0)
    for of, of_sample in zip(draws, weights, strict=True):
        of.events, of.weights = len(values), np.float32(of_sample)[:, np.newaxis]
    return drawn_distances(values, values, draws, NODES)[0]


@pytest.mark.parametrize("shift", [0.0, 0.3])
@pytest.mark.parametrize("shape", SHAPES)
def test_the_distance_on_the_grid_is_that_of_scipy(shape, shift):
    """On 256 bins within 5 % of its null."""
    rng = np.random.default_rng(8)
    values = SHAPES[shape](rng, 4000)
    null = drawn_distances(values, values, resampled((4000,) * 2, (4000, 5000), 20, 0), NODES)
    values[:3] = 1e5, -1e4, 3e5
    chances = np.exp(shift * np.clip(values, -3, 3))
    weights = [rng.multinomial(4000, np.full(4000, 1 / 4000))]
    weights += [rng.multinomial(5000, chances / chances.sum())]
    exact = scipy.stats.wasserstein_distance(values, values, *weights)
    assert distance_of(values, *weights) == pytest.approx(exact, abs=0.05 * null.mean())


@given(a=any_floats, b=any_floats)
def test_the_distance_of_few_values_on_the_grid_is_exact(a, b):
    a, b = a[np.isfinite(a)], b[np.isfinite(b)]
    if not (a.size and b.size):
        return
    of_a = np.arange(a.size + b.size) < a.size
    exact = scipy.stats.wasserstein_distance(a, b)
    found = distance_of(np.concatenate([a, b]), of_a, ~of_a)
    assert found == pytest.approx(exact, rel=1e-9, abs=1e-9)


def parameters(seed: int, shift: float = 0.0) -> dict[str, np.ndarray]:
    rng, means = np.random.default_rng(seed), {"drift_time": 1000, "tail_slope": -18}
    return {name: rng.normal(mean + shift, 100, 500) for name, mean in means.items()}


def test_compare_takes_any_methods():
    data = parameters(0)
    methods = {"raw": parameters(1, 300.0), "ren": parameters(2), "other": parameters(3, 50.0)}
    methods["raw"]["tail_slope"][:] = np.nan
    result = compare(data, methods, SCORES, seed=1)
    assert result.keys() == data.keys()
    drift, tail = result["drift_time"], result["tail_slope"]
    assert drift.iou.keys() == {*methods, "ceiling"}
    assert drift.iou["raw"] < drift.iou["other"] < drift.iou["ren"]
    assert drift.iou["ren"] == pytest.approx(drift.iou["ceiling"], abs=10)
    assert drift.wasserstein["raw"] == pytest.approx(300, rel=0.1)
    assert drift.wasserstein_null == pytest.approx(9, rel=0.25)  # of a width of 100
    assert drift.wasserstein["ren"] < drift.wasserstein_null + 3 * 3
    assert 0 < drift.wasserstein_null_std < drift.wasserstein_null
    assert drift.wasserstein_std["raw"] == pytest.approx(100 * np.sqrt(2 / 500), rel=0.4)
    assert tail.missing == {"data": 0, "raw": 500, "ren": 0, "other": 0}
    assert tail.iou["raw"] == 0
    assert tail.wasserstein["raw"] is tail.wasserstein_std["raw"] is None


@pytest.mark.parametrize("size", [2, 50])
def test_histograms_of_the_draws_are_multinomial(size, either_way):
    bins = np.repeat([1, 2, 4, 5], [1, 3, 4, 2])  # the last is drawn and not counted
    found = Resampled(10, size, 20_000, np.random.default_rng(12)).counts(bins, 5)
    assert found.shape == (5, 20_000)
    p = np.array([0, 1, 3, 0, 4]) / 10
    assert found.mean(axis=1) == pytest.approx(size * p, rel=0.03)
    covariance = size * (np.diag(p) - np.outer(p, p))
    assert np.cov(found) == pytest.approx(covariance, abs=0.03 * size)
    # all parameters see the same events
    draws, bins = Resampled(6, 6, 50, np.random.default_rng(2)), np.array([0, 1, 2, 2, 1, 0])
    if draws.weights is not None:
        np.testing.assert_array_equal(draws.counts(bins, 3)[::-1], draws.counts(2 - bins, 3))


def test_draws_without_a_finite_value_are_left_out():
    rare = np.r_[1.0, np.full(99, np.nan)]
    some = np.array([1.0, 2.0])
    w1 = drawn_distances(rare, some, resampled((100, 2), (100, 2), 200, 0), NODES)
    assert w1.std() == pytest.approx(0.5 / np.sqrt(2), rel=0.2)  # 0, ½ or 1, in ratios 1:2:1
    few = resampled((100, 2), (100, 2), 1, 1)
    few[0].weights[0] = 0
    assert np.isnan(drawn_distances(rare, some, few, NODES))
