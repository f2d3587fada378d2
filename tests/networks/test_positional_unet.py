"""The generator against the layer table of the paper's network and its own promises."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from cpunet.networks.positional_unet import PositionalUNet, positional_map
from cpunet.recipes import load_recipe
from cpunet.recipes.network_settings import PunetConfig

pytestmark = pytest.mark.usefixtures("same_random_numbers")


def narrow(width: int = 4, dropout: float = 0.0) -> PunetConfig:
    return PunetConfig(name="punet", width=width, dropout=dropout)


def test_the_paper_network_has_the_published_number_of_parameters():
    recipe = load_recipe("paper")
    network = PositionalUNet(recipe.generator, recipe.preparation.length)
    assert sum(p.numel() for p in network.parameters() if p.requires_grad) == 7_213_781


def test_every_stage_has_the_shape_of_the_layer_table():
    m = 6
    network = PositionalUNet(narrow(width=m), 800)
    shapes: dict[str, tuple[int, ...]] = {}

    def note(name: str):
        def hook(_module: nn.Module, _inputs: object, output: Tensor) -> None:
            shapes[name] = tuple(output.shape[1:])

        return hook

    stages = {"inlet": network.inlet, "mean": network.latent_mean}
    stages |= {"log variance": network.latent_log_variance, "outlet": network.outlet}
    stages |= {f"down{i}": block for i, block in enumerate(network.down, 1)}
    stages |= {f"up{i}": block for i, block in enumerate(network.up, 1)}
    for name, module in stages.items():
        module.register_forward_hook(note(name))
    network(torch.zeros(3, 1, 800))
    assert shapes == {
        "inlet": (m, 800),
        "down1": (2 * m, 400),
        "down2": (4 * m, 200),
        "down3": (8 * m, 100),
        "down4": (8 * m, 50),
        "mean": (8 * m, 50),
        "log variance": (8 * m, 50),
        "up1": (4 * m, 100),
        "up2": (2 * m, 200),
        "up3": (m, 400),
        "up4": (m // 2, 800),
        "outlet": (1, 800),
    }


def test_kernels_and_channels_of_the_blocks():
    m = 4
    network = PositionalUNet(narrow(width=m), 800)
    convolutions = [
        [layer for layer in block if isinstance(layer, nn.Conv1d)]
        for block in (network.inlet, *network.down, *network.up)
    ]
    assert all([c.kernel_size for c in pair] == [(11,), (7,)] for pair in convolutions)
    assert all(c.bias is None for pair in convolutions for c in pair)
    assert [[pair[0].in_channels, pair[0].out_channels] for pair in convolutions[5:]] == [
        [16 * m, 8 * m],
        [8 * m, 4 * m],
        [4 * m, 2 * m],
        [2 * m, m],
    ]


@pytest.mark.parametrize(
    ("channels", "samples", "offset"), [(2, 5, 0), (8, 50, 0), (12, 100, 24), (40, 400, 80)]
)
def test_positional_map_against_the_formula(channels, samples, offset):
    values = positional_map(channels, samples, offset)
    assert values.shape == (1, channels, samples)
    for channel in range(channels):
        frequency = 10000.0 ** (-(channel - channel % 2) / channels)
        wave = math.cos if channel % 2 else math.sin
        for sample in range(0, samples, max(1, samples // 7)):
            truth = wave((sample + offset) * frequency)
            assert float(values[0, channel, sample]) == pytest.approx(truth, abs=1e-6)


def test_maps_have_the_offsets_of_the_layer_table():
    m = 6
    network = PositionalUNet(narrow(width=m), 800)
    maps = [*network.maps_down, network.map_latent, *network.maps_up]
    expected = [
        (m, 800, 0),
        (2 * m, 400, 0),
        (4 * m, 200, 0),
        (8 * m, 100, 0),
        (8 * m, 50, 0),
        (4 * m, 100, 4 * m),
        (2 * m, 200, 2 * m),
        (m, 400, 2 * m),
    ]
    for module, arguments in zip(maps, expected, strict=True):
        assert torch.equal(module.values, positional_map(*arguments))


def test_a_map_is_added_before_the_dropout():
    network = PositionalUNet(narrow(dropout=0.5), 64).eval()
    module = network.maps_down[0]
    x = torch.randn(2, 4, 64)
    assert torch.equal(module(x), x + module.values)
    dropped = module.train()(torch.full((2, 4, 64), 5.0)) == 0
    assert 0.3 < float(dropped.float().mean()) < 0.7


def test_a_seeded_draw_comes_again():
    network = PositionalUNet(narrow(), 64).eval()
    pulses = torch.randn(2, 1, 64)
    first, again, other = (
        network(pulses, generator=torch.Generator().manual_seed(seed)) for seed in (7, 7, 8)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_a_draw_with_its_own_generator_leaves_the_global_one():
    network = PositionalUNet(narrow(), 64).eval()
    before = torch.get_rng_state()
    network(torch.zeros(2, 1, 64), generator=torch.Generator().manual_seed(1))
    network(torch.zeros(2, 1, 64), mean=True)
    assert torch.equal(torch.get_rng_state(), before)


def test_two_draws_differ_and_means_do_not():
    network = PositionalUNet(narrow(), 64).eval()
    pulses = torch.randn(2, 1, 64)
    assert not torch.equal(network(pulses), network(pulses))
    assert torch.equal(network(pulses, mean=True), network(pulses, mean=True))


def test_the_latent_draws_are_normal_with_the_learned_mean_and_variance():
    network = PositionalUNet(narrow(width=2), 16).eval()
    nn.init.zeros_(network.latent_mean.weight)
    nn.init.constant_(network.latent_mean.bias, 3.0)
    nn.init.zeros_(network.latent_log_variance.weight)
    nn.init.constant_(network.latent_log_variance.bias, math.log(0.25))
    latent: list[Tensor] = []
    network.map_latent.register_forward_pre_hook(lambda _, inputs: latent.append(inputs[0]))
    network(torch.zeros(2000, 1, 16))
    assert float(latent[0].detach().mean()) == pytest.approx(3.0, abs=0.02)
    assert float(latent[0].detach().std()) == pytest.approx(0.5, abs=0.02)


def test_in_evaluation_pulses_do_not_influence_each_other():
    network = PositionalUNet(narrow(), 64).eval()
    pulses = torch.randn(5, 1, 64)
    together = network(pulses, mean=True)
    alone = torch.cat([network(p[None], mean=True) for p in pulses])
    assert torch.allclose(together, alone, atol=1e-5)


@pytest.mark.parametrize("length", [808, 15, 799])
def test_lengths_that_cannot_be_halved_four_times(length):
    with pytest.raises(ValueError, match=f"the pulse length {length} is no multiple of 16"):
        PositionalUNet(narrow(), length)
