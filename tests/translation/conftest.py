"""A run of a network, and pulses for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch

from cpunet.recipes.schema import Recipe
from games import untrained
from synthetic import FACTS, SMALL_NETWORK, decaying_traces, edges, load_recipe, write_run


@pytest.fixture(scope="session")
def recipe() -> Recipe:
    return load_recipe("published", [*SMALL_NETWORK, "discriminator.samples_per_step=16"])


@pytest.fixture(scope="session")
def network(tmp_path_factory: pytest.TempPathFactory, recipe: Recipe) -> Path:
    """Folder of a run with random weights."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("run")
    write_run(folder, untrained(recipe), recipe, FACTS)
    return folder


@pytest.fixture
def sim() -> npt.NDArray[np.float32]:
    """Charge signals: edges of random width that end at 1."""
    return edges(5, seed=7).astype(np.float32)


@pytest.fixture
def data() -> npt.NDArray[np.float32]:
    """The like through a decay, in ADC counts on a baseline, with noise."""
    traces = decaying_traces(edges(5, seed=8), np.random.default_rng(8), noise_adc=8)
    return np.asarray(traces, np.float32)
