"""Games of generators and critics that are small enough to be repeated in every test."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from cpunet.networks.positional_unet import GruDiscriminator
from cpunet.recipes.schema import Recipe
from cpunet.training.adversarial import Game
from cpunet.training.network_runs import generators
from cpunet.training.views import Side, Sides
from synthetic import decay, edges, load_recipe, of_parts, small_sides, white_noise

# 64-sample pulses and the narrowest networks: an iteration takes milliseconds.
TINY = of_parts("""
preparation before_ns=512 after_ns=512 baseline_ns=256 tail_ns=32 decay_fit_ns=256
generator width=2
discriminator embedding_rows=20 embedding_dim=4 hidden=4 samples_per_step=4
training iterations=4 decay_start=2 batch_size=4 cycle_size=4 statistics_batches=2
training log_interval=3
training.losses baseline_ns=256 rising_edge_ns=384 tail_ns=384
""")
SMALL = of_parts("""
generator width=2
discriminator embedding_dim=2 hidden=2
training iterations=4 batch_size=4 cycle_size=2 log_interval=2 held_out=0.25
""")
RMS_KEV, KEV = 4.0, 2000.0


def as_published(*overrides: str) -> Recipe:
    """The published recipe, tiny."""
    return load_recipe("published", [*TINY, *overrides])


def mended(*overrides: str) -> Recipe:
    """The recipe `paper`, with the smallest networks."""
    return load_recipe("paper", [*SMALL, *overrides])


def windows(n: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """Simulated windows of 800 samples, and their like behind a decay, with noise."""
    rng = np.random.default_rng(3)
    sim = edges(n, 1, (1.5, 5.0), at=400, length=800)
    data = edges(n, 2, (3.0, 6.0), at=400, length=800) * decay(400, 1800, 800)
    data = 0.8 * data / data[:, -5:].mean(axis=1, keepdims=True)
    data += rng.normal(0, RMS_KEV / KEV, data.shape)
    return torch.from_numpy(sim).float(), torch.from_numpy(data).float()


def game_of(recipe: Recipe, n: int = 12) -> Game:
    """A game on pulses for this recipe."""
    published = recipe.generator.linear == "none"
    pair = map(torch.from_numpy, small_sides()) if published else windows(n)
    seen = 1 - recipe.training.held_out
    sim, data = (Side(x, np.full(len(x), KEV), round(seen * len(x))) for x in pair)
    noise = None if recipe.training.noise == "none" else white_noise(RMS_KEV)
    made = generators(recipe, decay=1 / 1800)
    sides = Sides(sim, data, recipe.preparation, noise, not published)
    return Game(made["ren"], made["iren"], sides, recipe.cyclegan)


def untrained(recipe: Recipe) -> dict[str, nn.Module]:
    """What a run of the published networks stores, with random weights."""
    critic = recipe.cyclegan.discriminator
    parts: dict[str, nn.Module] = {name: made.unet for name, made in generators(recipe).items()}
    return parts | {f"discriminator_{s}": GruDiscriminator(critic) for s in ("data", "sim")}
