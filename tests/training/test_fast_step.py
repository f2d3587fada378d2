"""The fast step against the plain one."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from cpunet.networks.time_major import fast_passes_pay
from cpunet.training.cyclegan import CycleGan, Step

pytestmark = pytest.mark.usefixtures("same_random_numbers")


def steps_of(tiny, dtype: torch.dtype) -> tuple[Step, Step]:
    """A plain and a fast step of the same networks."""
    recipe = tiny(
        "generator.width=4",
        "generator.dropout=0",
        "training.iterations=20",
        "training.decay_start=5",
        "training.discriminator_interval=3",
    )
    model = CycleGan(recipe).train().to(dtype)
    for network in (model.ren, model.iren):  # without noise, whose draws change places
        nn.init.zeros_(network.latent_log_variance.weight)
        nn.init.constant_(network.latent_log_variance.bias, -200.0)
    plain, fast = (
        Step(copy.deepcopy(model), recipe.cyclegan.training, fast=f) for f in (False, True)
    )
    return plain, fast


@pytest.mark.parametrize(
    ("dtype", "apart", "tolerance"),
    [
        (torch.float64, True, 1e-9),
        pytest.param(torch.float32, False, 1e-5, marks=pytest.mark.thorough),
    ],
)
@pytest.mark.parametrize("steps", [10, pytest.param(20, marks=pytest.mark.slow)])
def test_steps_have_the_same_losses(tiny, sets, dtype, apart, tolerance, steps):
    plain, fast = steps_of(tiny, dtype)
    sim, data = (torch.from_numpy(pulses[:, None]).to(dtype) for pulses in sets)
    for iteration in range(steps):
        rows = torch.randperm(len(data))[:4]
        expected = plain(iteration, sim[rows], data[rows.flip(0)])
        found = fast(iteration, sim[rows], data[rows.flip(0)])
        assert expected.keys() == found.keys()
        for name, value in expected.items():
            assert float(found[name]) == pytest.approx(float(value), rel=tolerance), (
                name,
                iteration,
            )
        if not apart:
            # Adam divides by gradients, which makes differences of rounding grow: plain steps
            # on other numbers of threads would be as far apart after a few
            fast.model.load_state_dict(plain.model.state_dict())
            fast.load_state_dict(copy.deepcopy(plain.state_dict()))


def test_wide_generators_on_a_cpu_take_the_fast_step(tiny):
    narrow = CycleGan(tiny())
    wide = CycleGan(tiny("generator.width=16"))
    assert not fast_passes_pay(narrow.ren, "cpu")
    assert fast_passes_pay(wide.ren, "cpu")
    assert not fast_passes_pay(wide.ren, "cuda")


def test_a_fast_step_can_be_repeated_bit_by_bit(tiny, sets):
    recipe = tiny("generator.width=16", "training.discriminator_interval=1")
    model = CycleGan(recipe).train()
    sim, data = (torch.from_numpy(pulses[:4, None]) for pulses in sets)
    weights = []
    for _ in range(2):
        torch.manual_seed(3)
        step = Step(copy.deepcopy(model), recipe.cyclegan.training)
        assert step.fast
        step(0, sim, data)
        step(1, sim, data)
        weights.append(step.model.state_dict())
    assert all(torch.equal(a, b) for a, b in zip(*map(dict.values, weights), strict=True))
