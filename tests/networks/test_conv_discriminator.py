"""The convolutional discriminator: what it sees, and its derivatives."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from cpunet.networks.discriminators import ConvDiscriminator
from cpunet.recipes.network_settings import ConvConfig

pytestmark = pytest.mark.usefixtures("same_random_numbers")


def make(**changes: Any) -> ConvDiscriminator:
    values = {"name": "conv", "width": 4, "layers": 3, "kernel": 5, "current_gain": 10.0}
    return ConvDiscriminator(ConvConfig.model_validate(values | changes))


def pulses(n: int = 6, length: int = 64) -> Tensor:
    edge = torch.linspace(0.3, 0.6, n)[:, None] * length
    return torch.sigmoid((torch.arange(length) - edge) / 2)[:, None]


def test_a_pulse_is_judged_by_itself():
    network, given = make().double(), pulses().double()
    together = network(given)
    assert together.shape == (6,)
    alone = torch.cat([network(pulse[None]) for pulse in given])
    assert torch.allclose(together, alone, atol=1e-12)


@pytest.mark.parametrize("length", [48, 50, 801])
def test_pulses_of_any_length_are_judged(length):
    assert torch.isfinite(make()(pulses(3, length))).all()


def test_it_has_right_first_and_second_derivatives():
    network, given = make(layers=2).double(), pulses(2, 16).double().requires_grad_()
    assert torch.autograd.gradcheck(network, given)
    assert torch.autograd.gradgradcheck(network, given)


def test_the_current_is_seen():
    """Without what the pulse itself goes through, pulses of other slopes still differ."""
    network, given = make(), pulses()
    with torch.no_grad():
        network.layers[0].weight[:, 0] = 0
        moved = network(given + 0.5)
        assert torch.allclose(network(given)[1:], moved[1:], atol=1e-6)
        assert not torch.allclose(network(given), network(given**2), atol=1e-4)


def test_it_learns_to_tell_slow_from_fast_edges():
    network = make()
    time = torch.arange(64.0)
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3)
    generator = torch.Generator().manual_seed(1)

    def draw(width: float) -> Tensor:
        middle = 25 + 14 * torch.rand(64, 1, generator=generator)
        return torch.sigmoid((time - middle) / width)[:, None]

    for _ in range(150):
        loss = nn.functional.softplus(-network(draw(2.0))).mean()
        loss = loss + nn.functional.softplus(network(draw(2.4))).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert (network(draw(2.0)) > 0).float().mean() > 0.9
    assert (network(draw(2.4)) < 0).float().mean() > 0.9
