"""The differentiable chain against the exact one of the test stands."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.fft
import torch

from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.exact_response import linear_response
from cpunet.networks.response_layer import (
    PADDING_AFTER,
    PADDING_BEFORE,
    ElectronicsResponse,
    fast_length,
)
from cpunet.pulses.container import Pulses
from cpunet.recipes.network_settings import ResponseConfig

DT_NS, FINE_PER_SAMPLE, SAMPLES = 16.0, 16, 800
RINGING = {"frequency_MHz": 5.0, "fraction": 0.1, "damping_ns": 160.0}


def electronics(poles: tuple[float, ...], ringing: dict | None = None) -> Electronics:
    """A chain with slow part and fast decay whose times are among the layer's fixed ones."""
    return Electronics.model_validate(
        read_electronics("legend200").model_dump()
        | {
            "bandwidth_poles_ns": poles,
            "slow": {"fraction": 0.065, "tau_ns": 400.0},
            "ringing": ringing,
            "decays": [{"fraction": 0.96, "tau_us": 80.0}, {"fraction": 0.04, "tau_us": 4.0}],
            "n_pre": PADDING_BEFORE,
            "length": PADDING_BEFORE + SAMPLES + PADDING_AFTER,
        }
    )


def layer(poles: tuple[float, ...], ringing: dict | None = None) -> ElectronicsResponse:
    """The same chain as a layer."""
    config = ResponseConfig(
        name="response",
        poles_ns=poles,
        slow_ns=(100, 400),
        decay_us=80,
        fast_decays_us=(4, 16),
        free_decays=False,
        ringing_mhz=None if ringing is None else ringing["frequency_MHz"],
        ringing_ns=RINGING["damping_ns"],
        drift_terms=0,
    )
    response = ElectronicsResponse(config, DT_NS)
    with torch.no_grad():
        response.slow_weights[1] = 0.065
        response.decay_weights[0] = 0.04
        if ringing is not None:
            response.ringing[0] = ringing["fraction"]
    return response.requires_grad_(False)


def fine_pulses(width_ns: float) -> Pulses:
    """Logistic charge pulses sampled every ns, at three phases of the digitiser's clock."""
    time_ns = np.arange(SAMPLES * FINE_PER_SAMPLE) + 0.5
    start_ns = 3000 + np.array([[0.0], [5.0], [11.0]])
    charge = 1 / (1 + np.exp(-(time_ns - start_ns) / width_ns))
    return Pulses.of(charge, dt_ns=1, energy_kev=np.full(3, 1000.0))


def windows(pulses: Pulses) -> torch.Tensor:
    """Means over the digitiser's period, as the layer takes them."""
    blocks = pulses.waveforms.reshape(len(pulses), -1, FINE_PER_SAMPLE)
    return torch.from_numpy(blocks.mean(axis=2, dtype=float)).float()


CHAINS = [((40.0, 40.0), None), ((55.0, 35.0), None), ((55.0, 35.0), RINGING), ((60.0,), None)]


@pytest.mark.parametrize(("poles", "ringing"), CHAINS)
@pytest.mark.parametrize("width_ns", [10, 20, 80])
def test_finely_simulated_pulses_come_out_as_from_the_exact_chain(poles, ringing, width_ns):
    pulses = fine_pulses(width_ns)
    got = layer(poles, ringing)(windows(pulses)).numpy()
    wanted = linear_response(pulses, electronics(poles, ringing))
    # 1e-4 is what a decay loses in half a sample: the layer's begins at a sample's edge,
    # 16 ns / 2 / 80 µs. The rest is the spline between the samples: at worst for a single
    # pole, which passes most of what is beyond half the sampling rate, and an edge of 44 ns.
    np.testing.assert_allclose(got, wanted, atol=5e-4)
    top = slice(PADDING_BEFORE + 400, PADDING_BEFORE + 700)
    np.testing.assert_allclose(got[:, top], wanted[:, top], atol=2e-4)


def test_a_step_is_that_of_the_exact_chain_averaged_over_the_period():
    chain = electronics((55.0, 35.0))
    samples = 600
    padded = fast_length(4 * samples)
    spectrum = layer((55.0, 35.0)).transfer(padded)
    got = torch.fft.irfft(spectrum, padded)[:samples].numpy()
    within = (np.arange(64) + 0.5) / 64
    wanted = chain.step_response((np.arange(samples)[:, None] + within) * DT_NS).mean(axis=1)
    # no spline has the corner of a step, which no pulse of a detector has either: 0.6 % there
    np.testing.assert_allclose(got, wanted, atol=8e-3)
    np.testing.assert_allclose(got[12:], wanted[12:], atol=8e-4)
    np.testing.assert_allclose(got[100:], wanted[100:], atol=2e-4)
    # charge is neither lost nor moved by the spline: its deviations cancel, but for the decay
    assert abs((got - wanted)[:40].sum()) < 40 * 2.5e-4


def test_the_decays_alone_are_sums_of_exponentials():
    time_us = torch.linspace(0, 50, 7, dtype=torch.float64)
    wanted = 0.96 * np.exp(-time_us.numpy() / 80) + 0.04 * np.exp(-time_us.numpy() / 4)
    np.testing.assert_allclose(layer((40.0,)).decay(time_us).numpy(), wanted, rtol=1e-12)


def test_records_have_room_and_nothing_wraps_around():
    pulses = windows(fine_pulses(20))
    records = layer((40.0, 40.0))(pulses)
    assert records.shape == (3, PADDING_BEFORE + SAMPLES + PADDING_AFTER)
    assert records.dtype == torch.float32
    assert float(records[:, :PADDING_BEFORE].abs().max()) < 2e-5


def test_pulses_of_any_height_and_time():
    response = layer((40.0, 40.0))
    pulses = windows(fine_pulses(20))
    later = torch.nn.functional.pad(pulses, (7, 0))[:, :SAMPLES]
    records, moved = response(pulses), response(3 * later)
    torch.testing.assert_close(moved[:, 7:-7], 3 * records[:, :-14], atol=1e-5, rtol=0)


def test_every_parameter_has_a_gradient():
    response = layer((55.0, 35.0), RINGING).requires_grad_(True)
    response(windows(fine_pulses(20)))[:, 300:700].square().sum().backward()
    for name, parameter in response.named_parameters():
        assert parameter.grad is not None, name
        assert bool((parameter.grad.abs() > 0).all()), name


def test_decays_may_have_times_of_their_own():
    fixed = layer((55.0, 35.0))
    config = fixed.config.model_copy(update={"free_decays": True})
    free = ElectronicsResponse(config, 16.0).requires_grad_(True)
    free.load_state_dict(fixed.state_dict(), strict=False)
    pulses = windows(fine_pulses(20))
    assert torch.equal(free(pulses), fixed(pulses))
    free.decay_weights.data.fill_(0.03)
    free.log_fast_decays_us.data.copy_(torch.tensor([3.0, 30.0]).log())
    free(pulses).square().sum().backward()
    assert free.log_fast_decays_us.grad is not None
    assert bool((free.log_fast_decays_us.grad.abs() > 0).all())
    told = free.describe()
    assert told["fast_decay_1_us"] == pytest.approx(3)
    assert told["fast_decay_2_share"] == pytest.approx(0.03)


def test_the_numbers_have_names_with_units_and_poles_are_sorted():
    told = layer((35.0, 55.0)).describe()
    assert told == pytest.approx(
        {
            "pole_1_ns": 55,
            "pole_2_ns": 35,
            "slow_100_ns": 0,
            "slow_400_ns": 0.065,
            "decay_us": 80,
            "decay_4_us": 0.04,
            "decay_16_us": 0,
        }
    )
    assert list(told)[:2] == ["pole_1_ns", "pole_2_ns"]


@pytest.mark.parametrize("least", [1, 2, 7, 97, 1021, 2240, 5443, 8192, 10_001])
def test_fast_lengths_are_the_least_even_ones(least):
    # twice the least product of 2, 3 and 5 that is at least half of it
    wanted = 2 * scipy.fft.next_fast_len(-(-least // 2), real=True)
    assert fast_length(least) == wanted
