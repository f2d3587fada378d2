"""Pulses whose drift is stretched, against pulses that drifted that long."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cpunet.networks.response_layer import DriftClock

DT_NS, END = 16.0, 400


def clock(*stretch: float) -> DriftClock:
    made = DriftClock(len(stretch)).requires_grad_(False)
    made.stretch.copy_(torch.tensor(stretch))
    return made


def rise(before_us: np.ndarray, long_us: float) -> np.ndarray:
    """Charge by the time before the end, smooth at both of its ends."""
    along = np.clip(1 - before_us / long_us, 0, 1)
    return along**3 * (10 - 15 * along + 6 * along**2)


def pulses(*long_us: float, samples: int = 800, dt_ns: float = DT_NS) -> torch.Tensor:
    before = 1e-3 * dt_ns * (END - np.arange(samples))
    return torch.from_numpy(np.stack([rise(before, u) for u in long_us]).astype(np.float32))


def test_nothing_changes_at_the_start():
    given = pulses(0.3, 1.0, 2.0)
    assert torch.equal(clock(0, 0)(given, dt_ns=DT_NS), given)


@pytest.mark.parametrize("stretch", [0.05, -0.05])
def test_a_stretched_drift_is_a_longer_one(stretch):
    at = int((pulses(1.0) >= 0.999).int().argmax())  # which stays where it is
    found = clock(stretch)(pulses(1.0), dt_ns=DT_NS)[0].numpy()
    before = 1e-3 * DT_NS * (END - np.arange(800))
    end = before[at]
    expected = rise(end + (before - end) / (1 + stretch), 1.0)
    assert np.abs(found - expected).max() < 1e-4
    assert np.abs(found - pulses(1.0)[0].numpy()).max() > 100 * 1e-4


def test_the_factor_changes_along_the_drift():
    a, b = 0.08, -0.03
    found = clock(a, b)(pulses(2.0), dt_ns=DT_NS)[0].numpy()
    before = 1e-3 * DT_NS * (END - np.arange(800))
    at = int((pulses(2.0) >= 0.999).int().argmax())
    late = before[:at] - before[at]
    expected = rise(before[at] + late / (1 + a + b * late), 2.0)
    assert np.abs(found[:at] - expected).max() < 1e-4


def test_a_template_may_keep_its_begin():
    """Templates of a library are summed by time, which counts from the begin of the drift."""
    fine = pulses(1.0, samples=1200, dt_ns=4.0)
    begin = END - 250
    kept = clock(0.1, 0.05)
    kept.keeps_begin = True
    found = kept(fine, dt_ns=4.0)[0].numpy()
    assert np.abs(found[: begin + 2]).max() < 1e-5
    assert found[begin + 12] > 1e-5
    took = int((fine[0] >= 0.999).int().argmax()) - begin
    long_us = 4e-3 * took
    expected = took * 1.1 / (1 - 0.05 * long_us)
    assert int((found >= 0.999).argmax()) - begin == pytest.approx(expected, abs=1.5)


def test_its_slope_is_that_of_finite_differences():
    changed = clock(0.05, -0.02).requires_grad_()
    weights = torch.linspace(-1, 1, 800).square()
    (changed(pulses(1.5), dt_ns=DT_NS)[0] @ weights).backward()
    slopes = changed.stretch.grad
    for i in range(2):
        ends = []
        for step in (1e-3, -1e-3):
            values = [0.05, -0.02]
            values[i] += step
            ends.append(float(clock(*values)(pulses(1.5), dt_ns=DT_NS)[0] @ weights))
        assert float(slopes[i]) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=0.02)


@given(
    a=st.floats(-0.3, 0.3),
    b=st.floats(-0.2, 0.2),
    seed=st.integers(0, 100),
    height=st.floats(0.1, 1e4),
)
def test_pulses_stay_pulses(a, b, seed, height):
    rng = np.random.default_rng(seed)
    long_us = rng.uniform(0.1, 3.0, 3)
    given = height * pulses(*long_us)
    found = clock(a, b)(given, dt_ns=DT_NS)
    assert torch.isfinite(found).all()
    assert float(found.min()) > -0.01 * height
    assert float(found.max()) < 1.01 * height
    assert torch.allclose(found[:, -1], given[:, -1])


def test_pulses_without_charge_pass():
    assert torch.equal(clock(0.1)(torch.zeros(2, 800), dt_ns=DT_NS), torch.zeros(2, 800))
