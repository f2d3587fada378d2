"""Alignment at half maximum and paired scores against analytic pulses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from cpunet.errors import CpunetError
from cpunet.pulses.half_maximum import align_half_maximum
from cpunet.validation import paired
from synthetic import paired_scores

TIME = np.arange(800.0)


def edge(time: np.ndarray, sigma: float) -> np.ndarray:
    """A Gaussian edge at 0, as after bandwidth poles; exactly 0.5 at time 0."""
    return ndtr(time / sigma)


@pytest.mark.parametrize("sigma", [2.5, 4.0, 10.0])  # 40 ns is the fastest real readout
def test_alignment_reproduces_the_analytic_pulse_at_any_phase(sigma):
    centres = 350 + np.linspace(0, 1, 101)[:, np.newaxis]
    aligned = align_half_maximum(edge(TIME - centres, sigma).astype(np.float32), 100, 150)
    expected = edge(np.arange(-100.0, 150.0), sigma)
    assert np.abs(aligned - expected).max() < 1e-4


def test_alignment_of_an_asymmetric_pulse():
    # half of the maximum lies where the edge is curved: a straight line would miss it
    def pulse(time):
        return 0.7 * ndtr(time / 3) + 0.3 * ndtr((time - 12) / 5)

    fine = np.linspace(-20, 20, 400_001)
    half = np.interp(0.5, pulse(fine), fine)
    centres = 350 + np.linspace(0, 1, 51)[:, np.newaxis]
    aligned = align_half_maximum(pulse(TIME - centres).astype(np.float32), 100, 100)
    assert np.abs(aligned - pulse(np.arange(-100, 100) + half)).max() < 1e-4


def test_the_last_crossing_before_the_maximum_counts():
    pulse = edge(TIME - 350, 4.0)
    pulse += np.where(np.abs(TIME - 200) < 20, 0.7, 0.0)  # an earlier pulse
    pulse[500:] = 0.0  # and nothing after the maximum matters
    aligned = align_half_maximum(pulse[np.newaxis].astype(np.float32), 50, 50)
    assert aligned[0] == pytest.approx(edge(np.arange(-50.0, 50.0), 4.0), abs=1e-4)


def test_outside_the_record_there_is_no_value():
    centre = 20.25
    aligned = align_half_maximum(edge(TIME[:60] - centre, 2.5)[np.newaxis], 30, 50)[0]
    known = np.isfinite(aligned)
    # the crossing at 20.25 has 20 samples before it, and 38 after it, in the record
    assert np.flatnonzero(known).tolist() == list(range(10, 69))


@pytest.mark.parametrize("row", [np.zeros(800), np.ones(800), -edge(TIME - 300, 4.0)])
def test_a_pulse_without_a_crossing_is_nan_and_its_neighbours_are_not(row):
    good = edge(TIME - 350, 4.0)
    aligned = align_half_maximum(np.stack([good, row, good]).astype(np.float32), 50, 50)
    assert np.isnan(aligned).all(axis=1).tolist() == [False, True, False]
    assert np.isfinite(aligned[[0, 2]]).all()


def test_a_nan_stays_in_its_pulse():
    pulses = np.stack([edge(TIME - 350, 4.0)] * 3).astype(np.float32)
    pulses[1, 700] = np.nan
    aligned = align_half_maximum(pulses, 50, 50)
    assert np.isnan(aligned).any(axis=1).tolist() == [False, True, False]


@given(shift=st.floats(-40, 40), sigma=st.floats(3, 20))
@settings(max_examples=40, deadline=None)
def test_a_shift_is_no_difference(shift, sigma):
    truth = edge(TIME - 350, sigma)[np.newaxis].astype(np.float32)
    moved = edge(TIME - 350 - shift, sigma)[np.newaxis].astype(np.float32)
    scores = paired_scores(moved, truth, 100)
    assert scores["rmse"] < 3e-5
    assert scores["edge_rmse"] < 6e-5


def test_equal_sets_score_zero():
    truth = edge(TIME - np.linspace(330, 370, 9)[:, np.newaxis], 4.0).astype(np.float32)
    assert paired_scores(truth, truth, 100) == {"rmse": 0, "edge_rmse": 0, "unaligned": 0}


def test_noise_scores_its_own_size():
    rng = np.random.default_rng(0)
    truth = np.repeat(edge(TIME - 350, 30.0)[np.newaxis], 300, axis=0)
    noisy = (truth + rng.normal(0, 1e-3, truth.shape)).astype(np.float32)
    # interpolation between samples smooths white noise a little
    assert paired_scores(noisy, truth.astype(np.float32), 100)["rmse"] == pytest.approx(
        1e-3, rel=0.2
    )


def test_windows_of_the_two_scores():
    truth = np.repeat(edge(TIME - 400, 4.0)[np.newaxis], 2, axis=0).astype(np.float32)
    other = truth.copy()
    other[0, 520] -= 0.1  # beyond the edge's window, and not its maximum
    scores = paired_scores(other, truth, 100)
    assert scores["edge_rmse"] < 1e-6
    assert scores["rmse"] == pytest.approx(0.1 / np.sqrt(2 * 800), rel=0.01)
    other[0, 490] -= 0.1
    expected = 0.1 / np.sqrt(2 * 201)
    assert paired_scores(other, truth, 100)["edge_rmse"] == pytest.approx(expected, rel=0.01)


def test_pairs_that_cannot_be_aligned_are_counted():
    truth = edge(TIME - np.linspace(330, 370, 5)[:, np.newaxis], 4.0).astype(np.float32)
    broken = truth.copy()
    broken[1] = 0
    broken[3, 5] = np.nan
    assert paired_scores(broken, truth, 100)["unaligned"] == 2
    nothing = paired_scores(broken[[1]], truth[[1]], 100)
    assert np.isnan(nothing["rmse"])
    assert nothing["unaligned"] == 1


def test_scores_do_not_depend_on_blocks(monkeypatch):
    rng = np.random.default_rng(0)
    truth = edge(TIME - rng.uniform(330, 370, (20, 1)), 4.0).astype(np.float32)
    noisy = truth + rng.normal(0, 1e-3, truth.shape).astype(np.float32)
    whole = paired_scores(noisy, truth, 100)
    monkeypatch.setattr(paired, "BLOCK", 3)
    assert paired_scores(noisy, truth, 100) == pytest.approx(whole)


def test_no_pairs_have_no_score():
    empty = np.zeros((0, 800), np.float32)
    assert np.isnan(paired_scores(empty, empty, 100)["rmse"])
    assert align_half_maximum(empty, 10, 20).shape == (0, 30)


def test_unequal_sets_are_refused():
    with pytest.raises(CpunetError, match="2 translated pulses cannot be paired with 3"):
        paired_scores(np.zeros((2, 800), np.float32), np.zeros((3, 800), np.float32), 100)
    with pytest.raises(CpunetError, match="expected"):
        align_half_maximum(np.zeros(800, np.float32), 10, 10)
