"""The generator against the layer table of the paper's network and its own promises."""

from __future__ import annotations

import math

import pytest
import torch

from cpunet.networks.positional_unet import PositionalMap, PositionalUNet
from cpunet.recipes.schema import PunetConfig
from synthetic import load_recipe

pytestmark = pytest.mark.usefixtures("same_random_numbers")


def narrow(width: int = 4, dropout: float = 0.0) -> PunetConfig:
    return PunetConfig(name="punet", width=width, dropout=dropout, linear="none")


def test_the_paper_network_has_the_published_number_of_parameters():
    recipe = load_recipe("published")
    network = PositionalUNet(recipe.generator, recipe.preparation.length)
    assert sum(p.numel() for p in network.parameters() if p.requires_grad) == 7_213_781


@pytest.mark.parametrize(
    ("channels", "samples", "offset"), [(2, 5, 0), (8, 50, 0), (12, 100, 24), (40, 400, 80)]
)
def test_positional_map_against_the_formula(channels, samples, offset):
    values = PositionalMap(channels, samples, offset, 0.0).values
    assert values.shape == (1, channels, samples)
    for channel in range(channels):
        frequency = 10000.0 ** (-(channel - channel % 2) / channels)
        wave = math.cos if channel % 2 else math.sin
        for sample in range(0, samples, max(1, samples // 7)):
            truth = wave((sample + offset) * frequency)
            assert float(values[0, channel, sample]) == pytest.approx(truth, abs=1e-6)


def test_a_seeded_draw_comes_again():
    network = PositionalUNet(narrow(), 64).eval()
    pulses = torch.randn(2, 1, 64)
    first, again, other = (
        network(pulses, generator=torch.Generator().manual_seed(seed)) for seed in (7, 7, 8)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("length", [808, 15, 799])
def test_lengths_that_cannot_be_halved_four_times(length):
    with pytest.raises(ValueError, match=f"the pulse length {length} is no multiple of 16"):
        PositionalUNet(narrow(), length)
