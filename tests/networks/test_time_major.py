"""The fast pass of a Positional U-Net against its own."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn

from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.tiled_convolution import convolve
from cpunet.networks.time_major import FrozenUNet, translate
from cpunet.recipes.network_settings import PunetConfig

pytestmark = pytest.mark.usefixtures("same_random_numbers")


@pytest.mark.parametrize("kernel", [1, 7, 11])
@pytest.mark.parametrize("length", [8, 50, 97])
@pytest.mark.parametrize(("channels_in", "channels_out"), [(1, 3), (6, 2), (40, 30)])
def test_a_convolution_and_its_gradients(kernel, length, channels_in, channels_out):
    x = torch.randn(4, channels_in, length, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(channels_out, channels_in, kernel, dtype=torch.float64)
    weight.requires_grad_()
    expected = nn.functional.conv1d(x, weight, padding="same")
    found = convolve(x.permute(2, 0, 1), weight).permute(1, 2, 0)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-11)
    slope = torch.randn_like(expected)
    wanted = torch.autograd.grad(expected, (x, weight), slope)
    given = torch.autograd.grad(found, (x, weight), slope)
    torch.testing.assert_close(given, wanted, rtol=0, atol=1e-10)


def test_rounding_of_a_convolution_in_float32():
    x, weight = torch.randn(8, 80, 200), torch.randn(40, 80, 11) / 30
    exact = nn.functional.conv1d(x.double(), weight.double(), padding="same")
    found = convolve(x.permute(2, 0, 1), weight).permute(1, 2, 0)
    assert float((found - exact).abs().max() / exact.abs().max()) < 3e-6


def make(dtype: torch.dtype, residual: bool) -> PositionalUNet:
    config = PunetConfig(name="punet", width=4, dropout=0.0, residual=residual)
    network = PositionalUNet(config, 64).to(dtype).train()
    # without latent noise, whose draws come in another order
    nn.init.zeros_(network.latent_log_variance.weight)
    nn.init.constant_(network.latent_log_variance.bias, -200.0)
    if residual:
        nn.init.normal_(network.outlet.weight)
    return network


@pytest.mark.parametrize("residual", [False, True])
def test_batches_together_are_batches_one_by_one(residual):
    network = make(torch.float64, residual)
    other = copy.deepcopy(network)
    a, b = torch.randn(2, 5, 1, 64, dtype=torch.float64)

    def gradients(net: PositionalUNet, outputs: tuple[Tensor, ...]) -> list[Tensor]:
        (outputs[0].square().sum() + 2 * outputs[1].abs().sum()).backward()
        return [p.grad for n, p in net.named_parameters() if "log_variance" not in n]

    expected, found = (network(a), network(b)), translate(other, a, b)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(
        gradients(other, found), gradients(network, expected), rtol=1e-8, atol=1e-8
    )
    for buffer, own in zip(network.buffers(), other.buffers(), strict=True):
        torch.testing.assert_close(own, buffer, rtol=1e-10, atol=1e-12)


def test_evaluation_takes_the_running_averages():
    network = make(torch.float64, False)
    network(torch.randn(5, 1, 64, dtype=torch.float64))
    network.eval()
    pulses = torch.randn(3, 1, 64, dtype=torch.float64)
    (found,) = translate(network, pulses)
    torch.testing.assert_close(found, network(pulses), rtol=1e-10, atol=1e-10)


def test_the_latent_noise_is_drawn_from_the_generator():
    network = make(torch.float32, False).eval()
    nn.init.zeros_(network.latent_log_variance.bias)
    pulses = torch.randn(3, 1, 64)
    draws = [
        translate(network, pulses, generator=torch.Generator().manual_seed(seed))[0]
        for seed in (1, 1, 2)
    ]
    assert torch.equal(draws[0], draws[1])
    assert not torch.allclose(draws[0], draws[2])


@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("mean", [False, True])
def test_a_frozen_network_translates_as_its_own(residual, mean):
    network = make(torch.float64, residual)
    nn.init.zeros_(network.latent_log_variance.bias)
    for _ in range(3):  # running averages of its own
        network(torch.randn(5, 1, 64, dtype=torch.float64))
    network.eval()
    frozen = FrozenUNet(network)
    for n in (1, 3, 20):  # the last in two blocks
        pulses = torch.randn(n, 1, 64, dtype=torch.float64)
        found, expected = (
            f(pulses, generator=torch.Generator().manual_seed(n), mean=mean)
            for f in (frozen.translate, network)
        )
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
