"""Overlap of distributions: nothing is dropped, and the ceiling is what it says."""

from __future__ import annotations

import json

import hist
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cpunet.analysis.comparisons import (
    ceiling,
    compare,
    data_axis,
    histogram,
    iou,
    iou_error,
    kolmogorov_smirnov,
    wasserstein,
)
from cpunet.errors import CpunetError
from cpunet.recipes.schema import ScoreConfig

SCORES = ScoreConfig(max_bins=49, bootstraps=50, drift_start_fraction=0.01, edge_samples=100)
UNIT = hist.axis.Regular(10, 0.0, 1.0)

any_floats = arrays(
    float,
    st.integers(1, 60),
    elements=st.one_of(st.floats(-1e6, 1e6), st.just(np.nan), st.just(np.inf)),
)


def test_range_comes_from_the_bulk_of_the_data():
    rng = np.random.default_rng(0)
    clean = rng.normal(5, 1, 5000)
    axis = data_axis(clean, 49)
    spoiled = data_axis(np.r_[clean, [1e12] * 20, -1e12, np.inf, np.nan], 49)
    assert spoiled.size == pytest.approx(axis.size, abs=6)
    assert -1 < spoiled.edges[0] < clean.min() + 0.1
    assert clean.max() - 0.1 < spoiled.edges[-1] < 11


@pytest.mark.parametrize("n", [100, 1000, 3000])
def test_bin_width_is_that_of_freedman_and_diaconis(n):
    data = np.linspace(0, 1, n)
    width = np.diff(data_axis(data, 49).edges)[0]
    assert width == pytest.approx(2 * 0.5 / np.cbrt(n), rel=0.1)


def test_number_of_bins_is_limited():
    assert data_axis(np.random.default_rng(0).normal(size=100_000), 49).size == 49


@given(data=any_floats.filter(lambda d: np.isfinite(d).any()))
@settings(max_examples=100, deadline=None)
def test_any_data_can_be_binned_and_every_event_is_counted(data):
    axis = data_axis(data, 49)
    assert 1 <= axis.size <= 49
    assert histogram(data, axis).sum() == len(data)
    assert iou(data, data, axis) == pytest.approx(100)


def test_equal_values_share_one_bin():
    axis = data_axis(np.full(20, 7.0), 49)
    assert histogram(np.array([7.0, 6.9, 7.1]), axis).tolist() == [1, 1, 1, 0]


def test_the_largest_value_is_no_overflow():
    data = np.linspace(0, 1, 11)
    assert histogram(data, data_axis(data, 49))[-2:].tolist() == [0, 0]


def test_without_finite_data_there_is_no_axis():
    with pytest.raises(CpunetError, match="no finite value"):
        data_axis(np.array([np.nan, np.inf]), 49)


@given(a=any_floats, b=any_floats)
@settings(max_examples=100, deadline=None)
def test_iou_is_symmetric_and_between_0_and_100(a, b):
    score = iou(a, b, UNIT)
    assert 0 <= score <= 100 + 1e-9
    assert score == pytest.approx(iou(b, a, UNIT))


def test_events_outside_the_range_lower_the_iou():
    inside = np.full(10, 0.55)
    mostly_outside = np.r_[0.55, np.full(9, 5.0)]
    # with density histograms these would score 100 %
    assert iou(inside, mostly_outside, UNIT) == pytest.approx(100 * 0.1 / 1.9)
    assert iou(inside, np.full(3, -5.0), UNIT) == 0
    assert iou(np.full(3, -5.0), np.full(3, 5.0), UNIT) == 0


def test_nans_are_no_match_for_numbers_nor_for_the_overflow():
    numbers, nans = np.full(10, 0.5), np.full(10, np.nan)
    assert iou(numbers, nans, UNIT) == 0
    assert iou(np.full(10, 99.0), nans, UNIT) == 0
    assert iou(numbers, np.r_[numbers, nans], UNIT) == pytest.approx(100 * 0.5 / 1.5)


def test_empty_bins_and_unequal_sizes_do_not_matter():
    a = np.array([0.05, 0.95])
    assert iou(a, np.repeat(a, 7), UNIT) == pytest.approx(100)


def test_one_event_against_one_event():
    assert iou(np.array([0.5]), np.array([0.5]), UNIT) == 100
    assert iou(np.array([0.5]), np.array([0.9]), UNIT) == 0


def test_an_empty_set_has_no_score():
    assert np.isnan(iou(np.array([]), np.array([0.5]), UNIT))
    assert np.isnan(wasserstein(np.array([]), np.array([0.5])))
    assert np.isnan(kolmogorov_smirnov(np.array([np.nan]), np.array([0.5])))
    assert np.isnan(iou_error(np.array([]), np.array([0.5]), UNIT, 5, 0))


def test_two_samples_of_one_distribution_score_near_the_ceiling():
    """Over many draws, the IoU of real samples has the ceiling's mean and spread."""
    rng = np.random.default_rng(3)
    n_data, n_sim = 800, 900
    real, ceilings, errors = [], [], []
    for draw in range(150):
        data, sim = rng.normal(size=n_data), rng.normal(size=n_sim)
        axis = data_axis(data, 49)
        real.append(iou(data, sim, axis))
        mean, error = ceiling(data, n_sim, n_data, axis, 50, draw)
        ceilings.append(mean)
        errors.append(error)
    assert np.mean(real) == pytest.approx(np.mean(ceilings), abs=1.0)
    assert np.std(real) == pytest.approx(np.mean(errors), rel=0.3)
    within = np.abs(np.subtract(real, ceilings)) < 2 * np.array(errors)
    assert within.mean() > 0.9


def test_the_ceiling_rises_with_the_number_of_events():
    data = np.random.default_rng(0).normal(size=1000)
    axis = data_axis(data, 49)
    means = [ceiling(data, n, n, axis, 50, 1)[0] for n in (100, 1000, 100_000)]
    assert means == sorted(means)
    assert means[-1] > 98


def test_iou_error_is_the_spread_over_repeated_samples():
    rng = np.random.default_rng(4)
    axis = hist.axis.Regular(20, -4, 4)
    scores, errors = [], []
    for draw in range(150):
        a, b = rng.normal(0, 1, 500), rng.normal(1, 1, 600)
        scores.append(iou(a, b, axis))
        errors.append(iou_error(a, b, axis, 50, draw))
    assert np.std(scores) == pytest.approx(np.mean(errors), rel=0.3)


def test_distances_against_known_shifts():
    a = np.linspace(0, 1, 1000)
    assert wasserstein(a, a + 0.25) == pytest.approx(0.25)
    assert kolmogorov_smirnov(a, a + 0.25) == pytest.approx(0.25, abs=2e-3)
    assert wasserstein(a, np.r_[a, np.nan, np.inf]) == pytest.approx(0)


def parameters(seed: int, shift: float = 0.0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "drift_time": rng.normal(1000 + shift, 100, 500),
        "tail_slope": rng.normal(-18 + shift, 0.1, 500),
    }


def test_compare_takes_any_methods_and_is_json_ready():
    data = parameters(0)
    methods = {"raw": parameters(1, 300.0), "ren": parameters(2), "rival": parameters(3, 50.0)}
    methods["raw"]["tail_slope"][:] = np.nan
    result = compare(data, methods, SCORES, seed=1)
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert result.keys() == data.keys()
    drift = result["drift_time"]
    assert drift["iou"].keys() == {"raw", "ren", "rival", "ceiling"}
    assert drift["iou"]["raw"] < drift["iou"]["rival"] < drift["iou"]["ren"]
    assert drift["iou"]["ren"] == pytest.approx(drift["iou"]["ceiling"], abs=10)
    assert drift["wasserstein"]["raw"] == pytest.approx(300, rel=0.1)
    assert drift["ks"]["raw"] > drift["ks"]["ren"]
    tail = result["tail_slope"]
    assert tail["missing"] == {"data": 0, "raw": 500, "ren": 0, "rival": 0}
    assert tail["iou"]["raw"] == 0
    assert tail["wasserstein"]["raw"] is None


def test_compare_gives_the_same_numbers_for_the_same_seed():
    data, methods = parameters(0), {"ren": parameters(1)}
    assert compare(data, methods, SCORES, seed=5) == compare(data, methods, SCORES, seed=5)


@pytest.mark.parametrize("values", [np.array([]), np.array([np.nan, np.nan])])
def test_compare_without_usable_data_gives_none(values):
    result = compare({"drift_time": values}, {"ren": parameters(1)}, SCORES, seed=1)
    assert set(result["drift_time"]["iou"].values()) == {None}
    assert result["drift_time"]["missing"]["data"] == len(values)


def test_compare_names_the_method_that_lacks_a_parameter():
    with pytest.raises(CpunetError, match="ren: parameter tail_slope is missing"):
        compare(parameters(0), {"ren": {"drift_time": np.ones(3)}}, SCORES, seed=1)
