"""Alignment at half maximum against analytic pulses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from cpunet.pulses.half_maximum import align_half_maximum

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
