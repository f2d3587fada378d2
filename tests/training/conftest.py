"""A training small enough to be repeated in every test."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from cpunet.pulses.container import FloatArray
from cpunet.pulses.preparation import Prepared, prepare
from cpunet.recipes.schema import Recipe
from synthetic import load_recipe, small_sides
from synthetic import same_random_numbers as same_random_numbers

# 64-sample pulses and the narrowest networks: an iteration takes milliseconds.
TINY = (
    "preparation.before_ns=512",
    "preparation.after_ns=512",
    "preparation.baseline_ns=256",
    "preparation.tail_ns=32",
    "preparation.decay_fit_ns=256",
    "generator.width=2",
    "discriminator.embedding_rows=20",
    "discriminator.embedding_dim=4",
    "discriminator.hidden=4",
    "discriminator.samples_per_step=4",
    "training.iterations=4",
    "training.decay_start=2",
    "training.batch_size=4",
    "training.statistics_batches=2",
    "training.log_interval=3",
    "training.losses.baseline_ns=256",
    "training.losses.rising_edge_ns=384",
    "training.losses.tail_ns=384",
)


@pytest.fixture
def tiny() -> Callable[..., Recipe]:
    """Make the paper's recipe tiny; arguments override more of it."""

    def make(*overrides: str) -> Recipe:
        return load_recipe("paper", [*TINY, *overrides])

    return make


@pytest.fixture
def sets() -> tuple[FloatArray, FloatArray]:
    """Eleven simulated and nine measured pulses of 64 samples."""
    return small_sides()


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> list[Prepared]:
    """Hold the alignment of the first preparation in all others.

    It is a whole number of samples, whose derivative is 0.  A finite difference across one of
    its steps would see the step.
    """
    first: list[Prepared] = []

    def once(*args) -> Prepared:
        if not first:
            first.append(prepare(*args))
        return first[0]

    monkeypatch.setattr("cpunet.training.cyclegan.prepare", once)
    return first
