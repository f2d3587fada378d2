"""The learned step response and the U-Net before it, where closed forms are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cpunet.networks.learned_response import (
    FIRST,
    MAX_LOG_RATE,
    DriftUNet,
    LearnedResponse,
    StepResponse,
)
from synthetic import PADDING_BEFORE, load_recipe

CONFIG = load_recipe("cpunet").generator
DT_NS, POLE_NS, DECAY_US = 16.0, 40.0, 60.0


@pytest.fixture
def step() -> StepResponse:
    response = StepResponse(CONFIG, DT_NS)
    response.set_base(POLE_NS, -DT_NS * 1e-3 / DECAY_US)
    return response


def test_the_base_is_a_step_through_two_poles_and_a_decay(step):
    before = round(-FIRST / DT_NS)
    # a step between two samples; at the edge, charge is interpolated between samples
    time = DT_NS * (np.arange(4, 700) + 0.5)
    poles = 1 - (1 + time / POLE_NS) * np.exp(-time / POLE_NS)
    found = step.step(700).detach().numpy()
    assert np.abs(found[: before - 4]).max() < 1e-3
    wanted = poles * np.exp(-time * 1e-3 / DECAY_US)
    np.testing.assert_allclose(found[before + 4 :], wanted, atol=3e-3)


@pytest.mark.parametrize("dt_ns", [8.0, 10.0, 16.0])
def test_the_prior_is_that_of_a_smooth_edge_at_any_sampling(dt_ns):
    response = StepResponse(CONFIG, dt_ns)
    lags = response.lags * dt_ns
    width = response.basis.square().sum(dim=1).sqrt()
    at = [int((lags - t).abs().argmin()) for t in (40.0, 600.0, 3000.0)]
    np.testing.assert_allclose(width[at], [0.145, 0.03, 0.03], rtol=0.05)
    assert width[lags < -40.0].max() < 0.002  # nothing before the charge


@pytest.mark.parametrize("pole_ns", [30.0, 50.0, 80.0])
def test_the_poles_of_a_base_follow_from_its_rise(step, pole_ns):
    step.set_base(pole_ns, 0.0)
    assert step.pole_ns() == pytest.approx(pole_ns, rel=0.03)


@pytest.mark.parametrize("dt_ns", [4.0, 10.0, 16.0])
def test_the_delay_is_the_half_rise_of_two_poles(dt_ns):
    response = LearnedResponse(CONFIG, dt_ns)
    response.step.set_base(POLE_NS, 0.0)
    # 1 - (1 + t) e^(-t) is 1/2 at 1.6783
    assert response.delay_ns() == pytest.approx(1.6783 * POLE_NS, abs=1)


def test_a_record_is_the_step_response_summed_over_the_current(step):
    response = LearnedResponse(CONFIG, DT_NS)
    response.step = step
    with torch.no_grad():
        step.coordinates.normal_(generator=torch.Generator().manual_seed(0))
        pulse = torch.zeros(1, 800)
        pulse[0, 300:] = 0.3
        pulse[0, 340:] = 1.0
        record = response(pulse)[0].numpy()
        known = step.step(1100).numpy()[round(-FIRST / DT_NS) :]
    at = np.arange(500, 1200)
    wanted = 0.3 * known[at - 300 - PADDING_BEFORE] + 0.7 * known[at - 340 - PADDING_BEFORE]
    np.testing.assert_allclose(record[at[60:]], wanted[60:], atol=2e-5)


def edges(n: int = 8) -> torch.Tensor:
    """Pulses whose current is a Gaussian of 6 to 20 samples."""
    width = torch.linspace(6, 20, n)[:, None]
    return 0.5 * (1 + torch.erf((torch.arange(800) - 380.5) / width / math.sqrt(2)))


def width_of(pulses: torch.Tensor) -> torch.Tensor:
    """Standard deviation of the current in samples."""
    current = torch.diff(pulses, dim=1)
    at = torch.arange(current.shape[1]) + 0.5
    mean = (current * at).sum(dim=1, keepdim=True)
    return (current * (at - mean).square()).sum(dim=1).sqrt()


def drift(log_rate: float = 0.0, variance: float = 0.0) -> DriftUNet:
    """A U-Net that does the same to all pulses."""
    network = DriftUNet(8, DT_NS).eval()
    with torch.no_grad():
        bias = network.network.outlet.bias
        bias[0] = math.atanh(log_rate / MAX_LOG_RATE)
        bias[1] = math.atanh(variance / network.max_blur)
    return network


def test_a_new_unet_changes_nothing():
    pulses = edges()
    torch.testing.assert_close(drift()(pulses), pulses, atol=1e-6, rtol=0)


@pytest.mark.parametrize("log_rate", [-0.1, 0.05])
def test_a_clock_of_one_rate_stretches_pulses_about_their_half_maximum(log_rate):
    pulses = edges()
    stretched = drift(log_rate)(pulses)
    wanted = width_of(pulses) * math.exp(log_rate)
    torch.testing.assert_close(width_of(stretched), wanted, rtol=5e-3, atol=0)
    assert (stretched[:, 380] - pulses[:, 380]).abs().max() < 2e-3


@pytest.mark.parametrize("variance", [-1.5, 2.0])
def test_a_blur_adds_its_variance(variance):
    pulses = edges()
    added = width_of(drift(variance=variance)(pulses)).square() - width_of(pulses).square()
    torch.testing.assert_close(added, torch.full_like(added, variance), rtol=0.02, atol=0)


def test_the_effect_is_told_in_times_and_variances_of_each_pulse():
    pulses = edges()
    before_ns, longer, blur_ns2 = drift(0.05, variance=2.0).effect(pulses)
    from_2_to_98 = 2 * 2.0537 * width_of(pulses)  # of a Gaussian
    torch.testing.assert_close(before_ns.float(), from_2_to_98 * DT_NS, rtol=5e-3, atol=0)
    wanted = (math.exp(0.1) + 2.0 / width_of(pulses).square()).sqrt() - 1
    assert (longer - wanted).abs().max() < 5e-3
    torch.testing.assert_close(blur_ns2, torch.full_like(blur_ns2, 2.0 * DT_NS**2))
