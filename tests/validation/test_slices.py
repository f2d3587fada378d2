"""Superpulses in slices of rise time, and differences from the truth, by plain loops."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from cpunet.errors import CpunetError
from cpunet.validation.figures import shape_figure
from cpunet.validation.methods import true_responses
from cpunet.validation.peaks import around_half, sliced
from synthetic import paired_scores, require_drawn

DT = 16.0
TIME = np.arange(800.0)


def pulses(rng, n, width=5.0, noise=0.002):
    """Edges whose drift, a slow first third, has a random length; and their times in ns."""
    drift = rng.uniform(20, 120, n)[:, np.newaxis]
    time = np.arange(300) - 150 - rng.uniform(0, 1, n)[:, np.newaxis]
    slow = 0.3 * np.clip((time + drift) / drift, 0, 1)
    windows = slow + 0.7 * ndtr(time / width) + rng.normal(0, noise, (n, 300))
    return windows.astype(np.float32), drift[:, 0] * DT


def superpulses(slices, **sets):
    """Superpulses of sets of pulses and times, by name."""
    times = {name: of_set[1] for name, of_set in sets.items()}
    return sliced(lambda name: sets[name][0], times, DT, slices)


def test_superpulses_are_those_of_a_plain_loop():
    windows, times = pulses(np.random.default_rng(1), 90)
    times[:2] = np.nan, np.inf
    windows[4] = 0.0
    found, means = superpulses(3, data=(windows, times))
    edges = np.quantile(np.delete(times, [0, 1]), [0, 1 / 3, 2 / 3, 1])
    np.testing.assert_allclose(found, edges)
    edges[-1] += 0.01  # the last edge is included
    for i, pulse in enumerate(means["data"][1:]):
        rows = [r for r in range(90) if edges[i] <= times[r] < edges[i + 1] and r != 4]
        aligned = around_half(windows[rows], DT).astype(float)
        assert pulse.n == len(rows)
        np.testing.assert_allclose(pulse.mean, aligned.mean(axis=0), atol=1e-6)
        expected = aligned.std(axis=0, ddof=1) / np.sqrt(len(rows))
        np.testing.assert_allclose(pulse.error, expected, atol=1e-6)


def test_nothing_in_a_slice_is_no_failure():
    windows, times = pulses(np.random.default_rng(5), 40)
    _, means = superpulses(2, data=(windows, times), raw=(windows, times + 1e6))
    assert all(pulse.n == 0 for pulse in means["raw"][1:])
    columns = {str(i): {m: of[i] for m, of in means.items()} for i in (1, 2)}
    require_drawn(shape_figure(columns, DT, "SEP"))


def edge(time: np.ndarray, sigma: float) -> np.ndarray:
    """A Gaussian edge at 0, as after bandwidth poles; exactly 0.5 at time 0."""
    return ndtr(time / sigma)


@given(shift=st.floats(-40, 40), sigma=st.floats(3, 20))
def test_a_shift_is_no_difference(shift, sigma):
    truth = edge(TIME - 350, sigma)[np.newaxis].astype(np.float32)
    moved = edge(TIME - 350 - shift, sigma)[np.newaxis].astype(np.float32)
    scores = paired_scores(moved, truth, 100)
    assert scores.rmse < 3e-5
    assert scores.edge_rmse < 6e-5


def test_windows_of_the_two_scores():
    truth = np.repeat(edge(TIME - 400, 4.0)[np.newaxis], 2, axis=0).astype(np.float32)
    other = truth.copy()
    other[0, 520] -= 0.1  # beyond the edge's window, and not its maximum
    scores = paired_scores(other, truth, 100)
    assert scores.edge_rmse < 1e-6
    assert scores.rmse == pytest.approx(0.1 / np.sqrt(2 * 800), rel=0.01)
    other[0, 490] -= 0.1
    expected = 0.1 / np.sqrt(2 * 201)
    assert paired_scores(other, truth, 100).edge_rmse == pytest.approx(expected, rel=0.01)


def test_pairs_that_cannot_be_aligned_are_counted():
    truth = edge(TIME - np.linspace(330, 370, 5)[:, np.newaxis], 4.0).astype(np.float32)
    broken = truth.copy()
    broken[1] = 0
    broken[3, 5] = np.nan
    assert paired_scores(broken, truth, 100).unaligned == 2
    nothing = paired_scores(broken[[1]], truth[[1]], 100)
    assert nothing.rmse is None
    assert nothing.unaligned == 1


def prepared(index, n_read):
    return SimpleNamespace(prepared=SimpleNamespace(index=index, n_read=n_read), path="sim.lh5")


@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_responses_are_those_of_the_pulses_in_use(tmp_path, dtype):
    path, response = tmp_path / "truth.npz", np.arange(40.0).reshape(20, 2).astype(dtype)
    np.savez_compressed(path, other=np.zeros(3), response=response)
    used = np.array([0, 1, 2, 9, 10, 17, 19])
    found = true_responses(path, prepared(used, 20))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, response[used])
    np.savez(path, response=np.full((20, 2), np.inf))
    with pytest.raises(CpunetError, match=r"truth.npz: no response is finite"):
        true_responses(path, prepared(np.arange(20), 20))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(CpunetError, match="cannot be read as NumPy file"):
        true_responses(path, prepared(np.arange(20), 20))
