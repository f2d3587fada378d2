"""A run that was really trained, if briefly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import Recipe
from cpunet.training.adversarial import Game, train
from cpunet.training.network_runs import generators
from cpunet.training.sides import Side, Sides
from synthetic import SMALL_NETWORK, decaying_traces, edges, load_recipe, write_run

DT_NS = 16.0


def simulated(n: int, seed: int) -> npt.NDArray[np.float32]:
    """Charge signals: edges of random width that end at 1."""
    return np.asarray(edges(n, seed), np.float32)


def measured(n: int, seed: int) -> npt.NDArray[np.float32]:
    """The same through a decay, in ADC counts on a baseline, with noise."""
    traces = decaying_traces(edges(n, seed), np.random.default_rng(seed), noise_adc=8)
    return np.asarray(traces, np.float32)


@pytest.fixture(scope="session")
def recipe() -> Recipe:
    return load_recipe(
        "published",
        [
            *SMALL_NETWORK,
            "discriminator.samples_per_step=16",
            "training.iterations=3",
            "training.statistics_batches=2",
        ],
    )


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory, recipe: Recipe) -> Path:
    """Folder of a run on twelve pulses a side."""
    sim = prepare(
        Pulses.of(simulated(12, seed=1), dt_ns=DT_NS), recipe.preparation, "simulated"
    )
    data = prepare(Pulses.of(measured(12, seed=2), dt_ns=DT_NS), recipe.preparation, "measured")
    pair = (Side.of(prepared.pulses, 0.0, seed=0) for prepared in (sim, data))
    sides, made = Sides(*pair, recipe.preparation, None, scaled=False), generators(recipe)
    game = train(lambda: Game(made["ren"], made["iren"], sides, recipe.cyclegan), 0)
    folder = tmp_path_factory.mktemp("run")
    info = {"recipe": recipe.name, "peak": "FEP", "seed": 0, "dt_ns": DT_NS}
    write_run(
        folder,
        {part: game.averaged(part).unet for part in ("ren", "iren")},
        recipe,
        info | {"seconds": 1.0, "device": "cpu"},
    )
    return folder


@pytest.fixture
def sim() -> npt.NDArray[np.float32]:
    return simulated(5, seed=7)


@pytest.fixture
def data() -> npt.NDArray[np.float32]:
    return measured(5, seed=8)
