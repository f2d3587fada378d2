"""Alignment at the half maximum, on pulses whose crossings are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from cpunet.recipes import load_recipe
from cpunet.training.half_maximum_alignment import at_half_maximum, crossing

CONFIG = load_recipe("fast").matching.training
TAIL_LEVEL = 0.8
LEVEL = 0.45
SAMPLES, LAST = 800, 401
STARTS = 360 + np.array([0.0, 0.25, 0.5, 0.9, 13.7])


def straight(start: np.ndarray, samples: int = SAMPLES, width: float = 20.0) -> Tensor:
    """Straight edges up to 0.9, which begin at fractions of a sample and never decay."""
    rise = np.clip((np.arange(samples) - start[:, np.newaxis]) / width, 0, 1)
    return torch.from_numpy((0.9 * rise).astype(np.float32))


def smooth(start: np.ndarray, samples: int = SAMPLES) -> Tensor:
    """Logistic edges with a decay."""
    time = np.arange(samples) - start[:, np.newaxis]
    pulses = 0.92 / (1 + np.exp(-time / 4)) * np.exp(-np.maximum(time, 0) / 3000)
    return torch.from_numpy(pulses.astype(np.float32))


def aligned(records: Tensor, last: int = LAST, level: float = LEVEL) -> Tensor:
    return at_half_maximum(records, level, last, CONFIG, TAIL_LEVEL)


@pytest.mark.parametrize("level", [0.1, 0.44, 0.8])
def test_crossings_of_straight_edges_are_exact(level: float) -> None:
    last = torch.full((len(STARTS),), LAST)
    time, before = crossing(straight(STARTS), level, last)
    wanted = STARTS + 20 * level / 0.9
    np.testing.assert_allclose(time.numpy(), wanted, atol=1e-4)
    assert before.tolist() == np.floor(wanted).astype(int).tolist()


def test_the_last_crossing_before_a_sample_counts() -> None:
    record = torch.zeros(1, 100)
    record[0, 20:40] = 1.0
    record[0, 60:80] = 1.0
    for last, wanted in ((30, 19.5), (70, 59.5)):
        time, _ = crossing(record, 0.5, torch.tensor([last]))
        assert float(time) == pytest.approx(wanted)


def test_the_crossing_comes_to_the_same_sample_for_all() -> None:
    windows = aligned(straight(STARTS))
    assert windows.shape == (len(STARTS), CONFIG.before + CONFIG.after)
    # scaled from 0.9 to 0.8, so that half of the maximum is later by a known time
    np.testing.assert_allclose(windows[:, CONFIG.before].numpy(), LEVEL, atol=1e-5)
    slope = TAIL_LEVEL / 20
    np.testing.assert_allclose(
        windows[:, CONFIG.before + 5].numpy(), LEVEL + 5 * slope, atol=1e-5
    )
    np.testing.assert_allclose(windows[:, : CONFIG.before - 20].numpy(), 0, atol=1e-6)


def test_a_shift_by_any_time_changes_little() -> None:
    """Straight lines between samples cost an eighth of the curvature, here 0.1/4² x 0.92."""
    windows = aligned(smooth(STARTS)).numpy()
    np.testing.assert_allclose(windows, np.broadcast_to(windows[0], windows.shape), atol=1.5e-3)
    whole = aligned(smooth(360 + np.array([0.0, 7.0]))).numpy()
    np.testing.assert_allclose(whole[1], whole[0], atol=1e-5)


def test_the_same_pulses_in_longer_records_give_the_same_windows() -> None:
    short, records = smooth(STARTS), smooth(STARTS + 200, 1400)
    np.testing.assert_allclose(
        aligned(records, LAST + 200 + 100).numpy(), aligned(short).numpy(), atol=1e-5
    )


@pytest.mark.parametrize(("offset", "factor"), [(0.03, 1.0), (0.0, 1.1), (-0.02, 0.9)])
def test_baseline_and_height_are_taken_out(offset: float, factor: float) -> None:
    pulses = smooth(STARTS)
    windows = aligned(factor * pulses + offset)
    np.testing.assert_allclose(windows.numpy(), aligned(pulses).numpy(), atol=2e-5)
    assert float(windows[:, :20].abs().max()) < 1e-4
    level = windows[:, -CONFIG.level_samples :].mean(dim=1).numpy()
    np.testing.assert_allclose(level, TAIL_LEVEL, atol=1e-3)
