"""Gaussian ⊗ exponential in place of a chain: found where it is one, told where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.electronics.exponentials import Exponentials
from cpunet.legend.equivalent import (
    ae_ratios,
    current_delay_ns,
    equivalent_kernel,
    kernel_step,
)


class KernelStep:
    """What is known of a chain, of Gaussian ⊗ exponential."""

    def step(self, time_ns: np.ndarray) -> np.ndarray:
        return kernel_step(time_ns, 30.0, 90.0)


def test_a_step_of_both() -> None:
    time = np.arange(-2000.0, 4000.0)
    gauss = np.exp(-0.5 * (np.arange(-600, 601) / 30.0) ** 2)
    step = np.convolve(1 - np.exp(-np.maximum(time, 0) / 90), gauss / gauss.sum(), "same")
    inner = slice(700, -700)
    np.testing.assert_allclose(kernel_step(time, 30.0, 90.0)[inner], step[inner], atol=2e-5)


def test_a_chain_that_is_one_is_found() -> None:
    found = equivalent_kernel(KernelStep())  # type: ignore[arg-type]
    assert found.sigma_ns == pytest.approx(30, abs=0.05)
    assert found.tau_ns == pytest.approx(90, abs=0.1)
    assert found.prompt_share == pytest.approx(1, abs=1e-3)
    assert found.current_error_percent < 0.05
    assert abs(found.late_charge_percent) < 1e-3
    assert found.ae_error_percent < 0.05


def test_what_two_numbers_cannot_follow_is_told() -> None:
    fast = Exponentials.low_pass(45.0) * Exponentials.low_pass(30.0)
    slow = fast * Exponentials.mixed(0.06, 800.0)
    without, found = equivalent_kernel(fast), equivalent_kernel(slow)
    # half of the slow charge is still to come when the peak is over by 500 ns
    assert found.late_charge_percent == pytest.approx(6 * np.exp(-500 / 800), abs=0.8)
    assert abs(without.late_charge_percent) < 0.1
    assert found.prompt_share < without.prompt_share
    assert 40 < current_delay_ns(fast) < 75
    time = np.arange(3000.0)
    charge = np.clip((time - 500) / np.array([[20.0], [60.0], [200.0]]), 0, 1)
    ratios = ae_ratios(charge, slow, found)
    assert ratios.shape == (3,)
    assert np.ptp(ratios) < 2e-2 * 2 * found.ae_error_percent
