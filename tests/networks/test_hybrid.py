"""A correction of records: nothing at first, nothing outside its stretch, and cheap."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.networks.hybrid import AFTER, BEFORE, EdgeResidual, HybridGenerator
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.recipes import load_recipe

RECIPE = load_recipe("best")
SAMPLES, HALF = 1400, 600


def records(n: int = 6, half: int = HALF) -> Tensor:
    """Edges of several widths that cross half of their maximum just after `half`, and decay."""
    time = torch.arange(SAMPLES)[None] - half - 0.3
    edge = torch.sigmoid(time / torch.linspace(2, 12, n)[:, None])
    return (edge * torch.exp(-0.0003 * time.clamp(min=0))).float()


@pytest.fixture
def residual() -> EdgeResidual:
    """One with weights that add something."""
    with torch.random.fork_rng():
        torch.manual_seed(1)
        made = EdgeResidual(RECIPE.residual)
        nn.init.normal_(made.outlet.weight)
    made.used.fill_(True)
    return made.eval().requires_grad_(False)


def test_a_new_one_adds_nothing():
    new = EdgeResidual(RECIPE.residual)
    for mode in (True, False):
        torch.testing.assert_close(new.train(mode)(records()), records(), rtol=0, atol=0)


def test_only_the_edge_is_changed(residual):
    added = residual(records()) - records()
    assert float(added.abs().max()) > 1e-3
    assert not added[:, : HALF - BEFORE].any()
    assert not added[:, HALF + AFTER + 1 :].any()
    # where nothing moves there is next to nothing to add
    assert float(added[0, HALF + 60 :].abs().max()) < 0.05 * float(added[0].abs().max())


def test_neither_height_nor_place_matter(residual):
    added = residual(records()) - records()
    higher = residual(3 * records()) - 3 * records()
    torch.testing.assert_close(higher, 3 * added, rtol=1e-4, atol=1e-5)
    later = residual(records(half=HALF + 37)) - records(half=HALF + 37)
    torch.testing.assert_close(later[:, 37:], added[:, :-37], rtol=1e-3, atol=1e-5)


def test_cleared_it_is_exactly_nothing(residual):
    residual.clear()
    for mode in (True, False):
        assert torch.equal(residual.train(mode)(records()), records())


def multiply_adds(network: nn.Module, *inputs: Tensor) -> int:
    """Of all convolutions for one pulse."""
    total = 0

    def count(layer: nn.Module, given: object, out: Tensor) -> None:
        nonlocal total
        assert isinstance(layer, nn.Conv1d)
        total += layer.weight.numel() * out.shape[-1]

    for layer in network.modules():
        if isinstance(layer, nn.Conv1d):
            layer.register_forward_hook(count)
    with torch.no_grad():
        network(*inputs)
    return total


def test_it_costs_less_than_a_thousandth_of_the_papers(residual):
    paper = load_recipe("paper")
    network = PositionalUNet(paper.generator, 800).eval()
    there = multiply_adds(network, torch.zeros(1, 1, 800))
    assert 0 < multiply_adds(residual, records(1)) < 1e-3 * there


def test_a_hybrid_is_its_chain_and_then_the_correction(residual):
    chain = ResponseGenerator(RECIPE.matching.generator, 16.0)
    chain.set_noise(BaselineNoise(np.ones(65), 128, 16.0, 7))
    hybrid = HybridGenerator(chain, residual)
    windows = (torch.arange(800)[None] >= 400).float()
    with torch.no_grad():
        assert torch.equal(hybrid(windows), residual(chain(windows)))
        assert not torch.equal(hybrid(windows), chain(windows))
    assert hybrid.noise.n_baselines == 7
    np.testing.assert_array_equal(hybrid.noise.density, chain.noise.density)
    assert hybrid.response is chain.response
