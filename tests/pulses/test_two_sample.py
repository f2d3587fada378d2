"""The two-sample test: calibrated where nothing differs, and not blind where it does."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from cpunet.errors import CpunetError
from cpunet.pulses import two_sample
from cpunet.pulses.two_sample import auc_and_variance, classifier_auc

TIME = np.arange(80.0)
SHAPE = np.exp(-0.5 * ((TIME - 40) / 5) ** 2)


def windows(rng, n, mean=0.0, spread=1.0, noise=0.01):
    """A bump of random height in white noise; its height is what may differ."""
    heights = rng.normal(mean, spread, n)
    return np.float32(heights[:, np.newaxis] * SHAPE + noise * rng.normal(size=(n, len(TIME))))


def edges(rng, n, width=4.0, noise=0.004):
    """Edges with a random amount of drift before them."""
    drift, share = rng.uniform(5, 25, (n, 1)), rng.uniform(0.2, 1, (n, 1))
    late, early = ndtr((TIME - 45) / width), ndtr((TIME - 45 + drift) / width)
    pulses = share * late + (1 - share) * early
    return np.float32(pulses + noise * rng.normal(size=pulses.shape))


def significance(result):
    return (result.auc - result.null_mean) / result.null_std


def test_equal_distributions_cannot_be_told_apart():
    """Over many draws the AUC is 0.5 within its errors, and so is the null."""
    rng = np.random.default_rng(0)
    sides = [(edges(rng, 120), edges(rng, 120)) for _ in range(30)]
    results = [classifier_auc(*pair, seed=draw) for draw, pair in enumerate(sides)]
    aucs = np.array([r.auc for r in results])
    assert aucs.mean() == pytest.approx(0.5, abs=0.015)
    assert np.mean([r.null_mean for r in results]) == pytest.approx(0.5, abs=0.01)
    null_std = np.mean([r.null_std for r in results])
    assert aucs.std() == pytest.approx(null_std, rel=0.3)
    assert np.mean([abs(significance(r)) < 2 for r in results]) > 0.85
    assert np.mean([abs(r.auc - 0.5) < 2 * r.auc_std for r in results]) > 0.85


def test_the_same_events_with_other_noise_are_no_difference():
    """Each is in one fold on both sides: trained on with one label, it would get the other."""
    rng = np.random.default_rng(2)
    pulses = windows(rng, 200)
    one, other = (pulses + rng.normal(0, 0.01, pulses.shape) for _ in range(2))
    other[3] = np.nan
    assert classifier_auc(one, other, seed=0).auc < 0.42
    alike = classifier_auc(one, other, seed=0, same_events=True)
    assert alike.auc == pytest.approx(0.5, abs=0.06)
    assert alike.n_data == alike.n_sim == 199
    moved = classifier_auc(one, other + SHAPE, seed=0, same_events=True)
    assert moved.auc == pytest.approx(ndtr(1 / np.sqrt(2)), abs=0.1)


@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0])
def test_a_shift_has_the_analytic_auc(shift):
    rng = np.random.default_rng(1)
    result = classifier_auc(windows(rng, 800), windows(rng, 800, mean=shift), seed=0)
    assert result.auc == pytest.approx(ndtr(shift / np.sqrt(2)), abs=0.03)
    assert significance(result) > 5


@pytest.mark.parametrize("change", [{"width": 4.1}, {"noise": 0.0043}])
def test_small_changes_of_real_pulses_are_seen(change):
    rng = np.random.default_rng(4)
    assert significance(classifier_auc(edges(rng, 600), edges(rng, 600, **change), seed=0)) > 5


def test_additional_features_are_used():
    rng = np.random.default_rng(6)
    sides = edges(rng, 400), edges(rng, 400)
    blind = classifier_auc(*sides, seed=0)
    values = tuple({"drift_time": rng.normal(mean, 50, 400)} for mean in (1000, 1100))
    seeing = classifier_auc(*sides, seed=0, features=values)
    assert abs(significance(blind)) < 3
    assert seeing.auc > 0.85  # 0.92 with nothing else to look at


def test_rows_that_are_not_finite_are_left_out_and_counted():
    rng = np.random.default_rng(7)
    data, others = edges(rng, 120), edges(rng, 110)
    data[3, 5] = np.nan
    others[:2] = np.inf
    slopes = [{"tail_slope": rng.normal(size=n)} for n in (120, 110)]
    slopes[0]["tail_slope"][[3, 10, 11, 12, 13]] = np.nan  # row 3 is left out already
    result = classifier_auc(data, others, seed=0, features=slopes)
    assert (result.missing_data, result.missing_sim) == (5, 2)
    assert result.n_data == result.n_sim == 108  # the smaller side
    assert 0.3 < result.auc < 0.7


def test_unequal_sides_and_the_cap(monkeypatch):
    rng = np.random.default_rng(10)
    data, others = windows(rng, 500), windows(rng, 100, mean=1.0)
    whole = classifier_auc(data, others, seed=0)
    assert whole.n_data == 100
    monkeypatch.setattr(two_sample, "LARGEST", 60)
    capped = classifier_auc(data, others, seed=0)
    assert capped.n_data == capped.n_sim == 60
    assert capped.auc_std > whole.auc_std


def test_rounding_is_no_difference():
    rng = np.random.default_rng(11)
    sides = (windows(rng, 200, noise=0.0) for _ in range(2))
    assert abs(significance(classifier_auc(*sides, seed=0))) < 3


def test_too_few_pulses_are_named():
    rng = np.random.default_rng(13)
    few, enough = windows(rng, 41), windows(rng, 60)
    few[:2] = np.nan
    for sides, said in (
        ((few, enough), "39 measured and 60 sim"),
        ((enough, few[:0]), "0 sim"),
    ):
        with pytest.raises(CpunetError, match=said):
            classifier_auc(*sides, seed=0)
    assert classifier_auc(enough[:40], enough[20:], seed=0).n_sim == 40


def test_auc_is_the_fraction_of_ordered_pairs():
    rng = np.random.default_rng(15)
    negatives, positives = rng.integers(0, 9, 30).astype(float), rng.integers(2, 12, 40) * 1.0
    difference = positives[:, np.newaxis] - negatives
    expected = (difference > 0).mean() + 0.5 * (difference == 0).mean()
    assert auc_and_variance(negatives, positives)[0] == pytest.approx(expected)
    assert auc_and_variance(positives, negatives)[0] == pytest.approx(1 - expected)


@pytest.mark.parametrize("shift", [0.0, 1.0, 2.5])
def test_variance_is_the_spread_over_repeated_samples(shift):
    rng = np.random.default_rng(16)
    columns = rng.normal(size=(60, 1500)), rng.normal(shift, 1.5, (90, 1500))  # samples
    aucs, variances = auc_and_variance(*columns)
    assert aucs.mean() == pytest.approx(ndtr(shift / np.hypot(1, 1.5)), abs=0.005)
    assert aucs.var() == pytest.approx(variances.mean(), rel=0.12)
