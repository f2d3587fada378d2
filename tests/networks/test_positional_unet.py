"""The generator against the layer table of the paper's network; a look-up with a gradient."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cpunet.networks.positional_unet import (
    GruDiscriminator,
    InterpolatedEmbedding,
    PositionalUNet,
)
from cpunet.recipes.schema import GruConfig
from synthetic import load_recipe
from synthetic import same_random_numbers as same_random_numbers

pytestmark = pytest.mark.usefixtures("same_random_numbers")


def test_the_paper_networks_have_the_published_numbers_of_parameters():
    recipe = load_recipe("published")
    unet = PositionalUNet(recipe.generator, recipe.preparation.length)
    for network, n in ((unet, 7_213_781), (GruDiscriminator(recipe.discriminator), 130_817)):
        assert sum(p.numel() for p in network.parameters() if p.requires_grad) == n


def config(**changes: Any) -> GruConfig:
    values = {"embedding_rows": 1000, "embedding_dim": 4, "hidden": 5, "samples_per_step": 1}
    values |= {"view": "window", "components": 1, "batch_norm": True}
    return GruConfig.model_validate({"name": "gru", **values, "value_range": None, **changes})


def pulses(n: int = 4, length: int = 48) -> Tensor:
    edge = torch.linspace(0.3, 0.6, n)[:, None] * length
    time = torch.arange(length)
    return torch.sigmoid((time - edge) / 2) * (1 - 0.2 * time / length)


@given(rows=st.integers(2, 1200), code=st.floats(0, 1))
def test_between_rows_it_is_their_weighted_mean(rows, code):
    table = InterpolatedEmbedding(rows, 3).double()
    position = code * (rows - 1)
    below = min(int(position), rows - 2)
    part = position - below
    expected = (1 - part) * table.weight[below] + part * table.weight[below + 1]
    assert torch.allclose(table(torch.tensor(code, dtype=torch.float64)), expected, atol=1e-9)


def test_a_fixed_range_makes_it_see_gain_and_offset_and_its_own_does_not():
    x, blind = pulses().double(), GruDiscriminator(config()).double().eval()
    assert torch.allclose(blind(x), blind(3.7 * x - 2.1), atol=1e-9)
    network = GruDiscriminator(config(value_range=(-0.5, 2.0))).double().eval()
    assert float((network(x) - network(0.95 * x)).detach().abs().min()) > 1e-6
    assert float((network(x) - network(x + 0.05)).detach().abs().min()) > 1e-6


def test_no_sample_is_lost_in_a_step_and_attention_changes_the_answer():
    network = GruDiscriminator(config(samples_per_step=8, value_range=(-1.0, 2.0))).eval()
    x = pulses(2).requires_grad_()
    before = network(x)
    before.sum().backward()
    assert bool((x.grad != 0).all())
    with torch.no_grad():
        network.attention.weight.mul_(-5)
    assert not torch.allclose(network(x), before)
