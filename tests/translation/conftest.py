"""A run that was really trained, if briefly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.training.loop import train
from cpunet.training.run_folder import write_run

DT_NS = 16.0


def simulated(n: int, seed: int = 1, length: int = 225) -> npt.NDArray[np.float32]:
    """Charge signals: edges of random width that end at 1."""
    rng = np.random.default_rng(seed)
    width = rng.uniform(1.5, 5, (n, 1))
    edges = 1 / (1 + np.exp(-(np.arange(length) - 60) / width))
    return np.asarray(edges, np.float32)


def measured(n: int, seed: int = 2) -> npt.NDArray[np.float32]:
    """The same through a decay, in ADC counts on a baseline, with noise."""
    rng = np.random.default_rng(seed)
    pulses = np.zeros((n, 1200))
    pulses[:, 500:725] = simulated(n, seed)
    pulses[:, 725:] = 1
    pulses *= np.exp(-np.clip(np.arange(1200) - 560, 0, None) * DT_NS / 55_000)
    return np.asarray(8000 + 20_000 * pulses + rng.normal(0, 8, pulses.shape), np.float32)


@pytest.fixture(scope="session")
def recipe() -> Recipe:
    return load_recipe(
        "paper",
        [
            "generator.width=2",
            "discriminator.embedding_dim=2",
            "discriminator.hidden=2",
            "discriminator.samples_per_step=16",
            "training.iterations=3",
            "training.batch_size=4",
            "training.statistics_batches=2",
        ],
    )


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory, recipe: Recipe) -> Path:
    """Folder of a run on twelve pulses a side."""
    sim = prepare(Pulses.of(simulated(12), dt_ns=DT_NS), recipe.preparation, "simulated")
    data = prepare(Pulses.of(measured(12), dt_ns=DT_NS), recipe.preparation, "measured")
    model = train(sim.pulses.waveforms, data.pulses.waveforms, recipe, seed=0)
    folder = tmp_path_factory.mktemp("run")
    info = {"recipe": recipe.name, "peak": "FEP", "seed": 0, "dt_ns": DT_NS}
    write_run(folder, model, recipe, info | {"seconds": 1.0, "device": "cpu"})
    return folder


@pytest.fixture
def sim() -> npt.NDArray[np.float32]:
    return simulated(5, seed=7)


@pytest.fixture
def data() -> npt.NDArray[np.float32]:
    return measured(5, seed=8)
