"""The discriminator: a look-up with a gradient, an attention that counts."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cpunet.networks.discriminators import GruDiscriminator, InterpolatedEmbedding
from cpunet.recipes import load_recipe
from cpunet.recipes.network_settings import GruConfig

pytestmark = pytest.mark.usefixtures("same_random_numbers")


def config(**changes: Any) -> GruConfig:
    values = {"embedding_rows": 1000, "embedding_dim": 4, "hidden": 5, "samples_per_step": 1}
    return GruConfig.model_validate({"name": "gru", **values, "value_range": None, **changes})


def pulses(n: int = 4, length: int = 48) -> Tensor:
    edge = torch.linspace(0.3, 0.6, n)[:, None] * length
    time = torch.arange(length)
    return torch.sigmoid((time - edge) / 2)[:, None] * (1 - 0.2 * time / length)


def test_the_paper_network_has_the_published_number_of_parameters():
    network = GruDiscriminator(load_recipe("paper").discriminator)
    assert sum(p.numel() for p in network.parameters() if p.requires_grad) == 130_817


@given(rows=st.integers(2, 1200))
def test_whole_codes_give_the_rows_themselves(rows):
    table = InterpolatedEmbedding(rows, 3).double()
    codes = torch.arange(rows, dtype=torch.float64)
    found = table(codes / (rows - 1))
    # a code divided and multiplied again is whole to rounding only
    assert torch.allclose(found, table.weight, atol=1e-9)


@given(rows=st.integers(2, 1200), code=st.floats(0, 1))
def test_between_rows_it_is_their_weighted_mean(rows, code):
    table = InterpolatedEmbedding(rows, 3).double()
    position = code * (rows - 1)
    below = min(int(position), rows - 2)
    part = position - below
    expected = (1 - part) * table.weight[below] + part * table.weight[below + 1]
    assert torch.allclose(table(torch.tensor(code, dtype=torch.float64)), expected, atol=1e-9)


def test_the_look_up_has_the_gradient_that_finite_differences_find():
    table = InterpolatedEmbedding(10, 3).double()
    whole = torch.arange(9, dtype=torch.float64)
    fraction = ((whole + torch.linspace(0.2, 0.8, 9)) / 9).requires_grad_()
    assert torch.autograd.gradcheck(table, (fraction,))
    table(fraction).square().sum().backward()
    assert bool((fraction.grad != 0).all())
    assert bool((table.weight.grad != 0).any(dim=1).all())


def test_values_outside_the_table_get_its_ends():
    table = InterpolatedEmbedding(10, 3)
    assert torch.equal(table(torch.tensor([-0.5, 1.5])), table.weight[[0, -1]])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rows", [2, 1000])
@pytest.mark.parametrize(
    "values",
    [torch.ones(2, 1, 32), torch.zeros(2, 1, 32), torch.full((2, 1, 32), 1e4)],
    ids=["one", "zero", "large"],
)
def test_constant_pulses_are_judged(dtype, rows, values):
    for value_range in (None, (0.0, 1.0)):
        network = GruDiscriminator(config(embedding_rows=rows, value_range=value_range))
        logits = network.to(dtype)(values.to(dtype))
        assert logits.dtype == dtype
        assert bool(torch.isfinite(logits).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_maximum_is_the_last_row(dtype):
    table = InterpolatedEmbedding(1000, 4).to(dtype)
    one = torch.ones((), dtype=dtype)
    below = torch.nextafter(one, 0 * one)
    assert torch.equal(table(one), table.weight[999])
    assert torch.allclose(table(below), table.weight[999], atol=1e-3)


def test_its_own_range_makes_it_blind_to_gain_and_offset():
    network = GruDiscriminator(config()).double().eval()
    x = pulses().double()
    assert torch.allclose(network(x), network(3.7 * x - 2.1), atol=1e-9)


def test_a_fixed_range_makes_it_see_gain_and_offset():
    network = GruDiscriminator(config(value_range=(-0.5, 2.0))).double().eval()
    x = pulses().double()
    assert float((network(x) - network(0.95 * x)).detach().abs().min()) > 1e-6
    assert float((network(x) - network(x + 0.05)).detach().abs().min()) > 1e-6


def test_a_gradient_reaches_the_pulses():
    network = GruDiscriminator(config(value_range=(-0.5, 1.5)))
    x = pulses().requires_grad_()
    network(x).sum().backward()
    assert bool((x.grad != 0).all())


def test_the_attention_matrix_changes_the_answer_and_learns():
    network = GruDiscriminator(config()).eval()
    before = network(pulses())
    before.sum().backward()
    assert bool((network.attention.weight.grad != 0).any())
    with torch.no_grad():
        network.attention.weight.mul_(-5)
    assert not torch.allclose(network(pulses()), before)


def test_every_parameter_learns():
    network = GruDiscriminator(config())
    network(pulses())[:2].sum().backward()
    still = [n for n, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert still == []


@pytest.mark.parametrize("samples_per_step", [1, 2, 8, 48])
def test_steps_of_several_samples(samples_per_step):
    network = GruDiscriminator(config(samples_per_step=samples_per_step)).eval()
    lengths: list[int] = []
    network.gru.register_forward_hook(
        lambda _, inputs, _out: lengths.append(inputs[0].shape[1])
    )
    logits = network(pulses(4))
    assert logits.shape == (4,)
    assert lengths == [48 // samples_per_step]


def test_no_sample_is_lost_in_a_step():
    network = GruDiscriminator(config(samples_per_step=8, value_range=(-1.0, 2.0))).eval()
    x = pulses(2).requires_grad_()
    network(x).sum().backward()
    assert bool((x.grad != 0).all())
