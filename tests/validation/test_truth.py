"""The truth's traces, read block by block, and differences from it against analytic pulses."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from cpunet.errors import CpunetError
from cpunet.validation.truth import Responses
from synthetic import paired_scores

TIME = np.arange(800.0)


def edge(time: np.ndarray, sigma: float) -> np.ndarray:
    """A Gaussian edge at 0, as after bandwidth poles; exactly 0.5 at time 0."""
    return ndtr(time / sigma)


@given(shift=st.floats(-40, 40), sigma=st.floats(3, 20))
@settings(max_examples=40, deadline=None)
def test_a_shift_is_no_difference(shift, sigma):
    truth = edge(TIME - 350, sigma)[np.newaxis].astype(np.float32)
    moved = edge(TIME - 350 - shift, sigma)[np.newaxis].astype(np.float32)
    scores = paired_scores(moved, truth, 100)
    assert scores["rmse"] < 3e-5
    assert scores["edge_rmse"] < 6e-5


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


def prepared(index, n_read):
    return SimpleNamespace(
        prepared=SimpleNamespace(index=index, n_read=n_read), path="sim.lh5", dt_ns=16.0
    )


@pytest.mark.parametrize("size", [1, 3, 7, 100])
@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_responses_are_those_of_the_pulses_in_use_whatever_the_block(tmp_path, size, dtype):
    response = np.arange(40.0).reshape(20, 2).astype(dtype)
    np.savez_compressed(tmp_path / "truth.npz", other=np.zeros(3), response=response)
    used = np.array([0, 1, 2, 9, 10, 17, 19])
    blocks = list(Responses(tmp_path / "truth.npz", prepared(used, 20)).blocks(size))
    assert [len(block) for block in blocks[:-1]] == [size] * (len(blocks) - 1)
    assert all(block.dtype == np.float32 for block in blocks)
    np.testing.assert_array_equal(np.concatenate(blocks), response[used])


def test_responses_that_cannot_be_read(tmp_path):
    path = tmp_path / "truth.npz"
    np.savez(path, response=np.ones((20, 300)))
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(CpunetError, match="cannot be read as NumPy file"):
        Responses(path, prepared(np.arange(20), 20))
