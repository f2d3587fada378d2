"""Linearity of a translation: exact for convolutions, as predicted for a square."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import fftconvolve
from scipy.special import ndtr

from cpunet.electronics.finishing import finish
from cpunet.errors import CpunetError
from cpunet.recipes.schema import PreparationConfig
from cpunet.validation.linearity import linearity_residual

CONFIG = PreparationConfig(
    samples_before=200,
    samples_after=200,
    align_fraction=0.999,
    baseline_samples=50,
    tail_samples=5,
    tail_level=0.8,
    decay_fit_samples=100,
    max_padding_before=400,
    max_padding_after=400,
    saturation_run=4,
)
TIME = np.arange(400.0)


def sites(rng, n):
    """Pulses of one site each, at their maximum at sample 200."""
    start = rng.uniform(20, 90, n)[:, np.newaxis]
    share = rng.uniform(0.1, 0.5, n)[:, np.newaxis]
    ramp = np.clip((TIME - 200 + start) / start, 0, 1)
    return np.float32(share * ramp + (1 - share) * ramp**8)


def kernel(width=4.0, decay=3000.0):
    time = np.arange(-40.0, 1200)
    impulse = np.exp(-(time**2) / 2 / width**2) / width / np.sqrt(2 * np.pi)
    # overshoot: a slow part that moves the maximum by several samples
    response = np.convolve(
        impulse, 0.97 * (time >= 0) + 0.03 * np.exp(-time / 60) * (time >= 0)
    )
    return response[: len(time)] * np.exp(-np.clip(time, 0, None) / decay)


def convolved(windows, square=0.0):
    """A readout, aligned and normalised as the package's translations are."""
    current = np.diff(np.pad(windows, ((0, 0), (401, 400)), mode="edge"), axis=1)
    records = fftconvolve(current, kernel()[np.newaxis], axes=1)[:, 40 : 40 + 1200]
    records = records + square * records**2
    return finish(records.astype(np.float32), CONFIG, dt_ns=16.0).windows


def test_a_convolution_is_linear_wherever_its_maximum_is():
    windows = sites(np.random.default_rng(0), 60)
    found = linearity_residual(convolved, windows, np.random.default_rng(1), pairs=60)
    assert found["pairs"] == 60
    assert found["not_translated"] == found["unmatched"] == 0
    assert found["rms"]["q90"] < 2e-6
    assert found["edge_rms"]["q90"] < 4e-6
    # the parts decay at different times, by 1/3000 a sample
    assert found["shared_edge_rms"]["q90"] < 1e-4
    assert found["move_samples"]["q90"] >= 1  # the alignment did move the parts
    assert found["ambiguity_samples"]["median"] < 1e-3
    json.dumps(found, allow_nan=False)


def test_moves_of_parts_of_a_sample_are_found():
    def late(windows):
        # as smooth as a measured pulse, and later by how slow its first half is
        centre = 150 + 50 * windows[:, 100:200].mean(axis=1, keepdims=True)
        return ndtr((TIME - centre) / 5).astype(np.float32)

    def one_shape(n):
        return sites(np.random.default_rng(2), n)

    # all results are one shape: the sum's is a moved part, whatever the moves are
    found = linearity_residual(late, one_shape(30), np.random.default_rng(3), pairs=30)
    assert found["rms"]["q90"] < 2e-4


def smooth(rng, n):
    """Two-sided edges, known at any time: centres and widths."""
    return rng.uniform(180, 220, n), rng.uniform(6, 14, n)


def test_a_square_leaves_what_an_independent_fit_of_exact_pulses_leaves():
    square = 0.2
    rng = np.random.default_rng(4)
    centre, width = smooth(rng, 2)

    def shape(i, time):
        z = ndtr((time - centre[i]) / width[i])
        return z + square * z**2

    windows = ndtr((TIME - centre[:, None]) / width[:, None]).astype(np.float32)
    found = linearity_residual(
        lambda w: w + square * w**2, windows, np.random.default_rng(5), pairs=1
    )
    again = np.random.default_rng(5)
    first = int(again.integers(2, size=1)[0])
    again.integers(1, 2, size=1)
    w = again.uniform(0.2, 0.8, size=1)[0]
    inner = TIME[34:-34]
    z = w * ndtr((inner - centre[first]) / width[first]) + (1 - w) * ndtr(
        (inner - centre[1 - first]) / width[1 - first]
    )
    target = z + square * z**2

    def residual(p):
        return (
            p[0] * shape(first, inner - p[1]) + p[2] * shape(1 - first, inner - p[3]) - target
        )

    best = least_squares(residual, [w, 0, 1 - w, 0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    expected = np.sqrt(np.mean(best.fun**2))
    assert expected > 1e-4
    assert found["rms"]["median"] == pytest.approx(expected, rel=0.01)


def test_the_residual_grows_with_the_square():
    rng = np.random.default_rng(6)
    windows = sites(rng, 40)
    small, large = (
        linearity_residual(
            lambda w, c=c: convolved(w, c), windows, np.random.default_rng(7), pairs=40
        )
        for c in (0.05, 0.1)
    )
    assert small["edge_rms"]["median"] > 5e-6
    assert large["shared_edge_rms"]["median"] > 2 * large["edge_rms"]["median"]
    ratio = large["edge_rms"]["median"] / small["edge_rms"]["median"]
    assert ratio == pytest.approx(2, rel=0.15)


def test_equal_pulses_are_one_and_their_moves_ambiguous():
    windows = np.repeat(sites(np.random.default_rng(8), 1), 5, axis=0)
    found = linearity_residual(convolved, windows, np.random.default_rng(9), pairs=10)
    assert found["pairs"] == 10
    assert found["rms"]["q90"] < 1e-6


def test_pairs_left_out_are_counted():
    windows = sites(np.random.default_rng(10), 20)

    def some(w):
        result = convolved(w)
        result[::4] = np.nan
        return result

    found = linearity_residual(some, windows, np.random.default_rng(11), pairs=30)
    assert found["not_translated"] > 8
    assert found["pairs"] + found["not_translated"] + found["unmatched"] == 30

    none = linearity_residual(
        lambda w: np.full_like(w, np.nan), windows, np.random.default_rng(12), pairs=5
    )
    assert none["missing"] == "no pair of pulses could be translated and matched"


def test_sums_that_have_moved_out_of_reach_are_unmatched():
    windows = sites(np.random.default_rng(13), 20)

    def jumps(w):
        # sums are given as a set of their own
        return np.roll(convolved(w), 60 * (len(w) == 7), axis=1)

    found = linearity_residual(jumps, windows, np.random.default_rng(14), pairs=7)
    assert found["unmatched"] == 7
    assert found["pairs"] == 0


@pytest.mark.parametrize(("n", "pairs"), [(1, 5), (5, 0)])
def test_too_little_is_refused(n, pairs):
    with pytest.raises(CpunetError, match="2 pulses and a pair"):
        linearity_residual(
            lambda w: w, np.zeros((n, 400), np.float32), np.random.default_rng(), pairs
        )


def test_another_shape_is_refused():
    with pytest.raises(CpunetError, match="a row for each"):
        linearity_residual(
            lambda w: w[:, :-1], sites(np.random.default_rng(15), 5), np.random.default_rng(), 3
        )
