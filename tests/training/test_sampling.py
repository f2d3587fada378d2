"""Unpaired means unpaired, and no pulse is thrown away."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cpunet.training import loop
from cpunet.training.cyclegan import Step
from cpunet.training.loop import EpochSampler, train
from synthetic import LOSS_NAMES


def numbered(n: int, samples: int = 3) -> torch.Tensor:
    return torch.arange(n, dtype=torch.float32)[:, None, None].expand(n, 1, samples)


def numbers(batch: torch.Tensor) -> list[int]:
    return [int(x) for x in batch[:, 0, 0]]


@given(n=st.integers(1, 60), batch_size=st.integers(2, 20), seed=st.integers(0, 2**32))
def test_every_batch_is_full_and_holds_pulses_of_the_set(n, batch_size, seed):
    sampler = EpochSampler(numbered(n), batch_size, seed)
    for _ in range(5):
        batch = sampler.next_batch()
        assert batch.shape == (batch_size, 1, 3)
        assert set(numbers(batch)) <= set(range(n))


@given(n=st.integers(2, 60), batch_size=st.integers(2, 20), seed=st.integers(0, 2**32))
def test_between_two_shuffles_no_pulse_comes_twice(n, batch_size, seed):
    sampler = EpochSampler(numbered(n), batch_size, seed)
    for _ in range(3):
        dealt = [i for _ in range(n // batch_size) for i in numbers(sampler.next_batch())]
        assert len(set(dealt)) == len(dealt)


@given(n=st.integers(1, 60), batch_size=st.integers(2, 20), seed=st.integers(0, 2**32))
def test_every_pulse_is_used(n, batch_size, seed):
    # chance to miss one in a shuffle is below 1/2, with replacement below exp(-1) a batch
    sampler = EpochSampler(numbered(n), batch_size, seed)
    used = {
        i for _ in range(60 * max(1, n // batch_size)) for i in numbers(sampler.next_batch())
    }
    assert used == set(range(n))


@given(n=st.integers(2, 40), seed=st.integers(0, 2**32))
def test_the_same_seed_deals_the_same(n, seed):
    samplers = [EpochSampler(numbered(n), 4, s) for s in (seed, seed)]
    assert [numbers(samplers[0].next_batch()) for _ in range(20)] == [
        numbers(samplers[1].next_batch()) for _ in range(20)
    ]


def test_another_seed_deals_otherwise():
    samplers = [EpochSampler(numbered(40), 4, seed) for seed in (1, 2)]
    assert numbers(samplers[0].next_batch()) != numbers(samplers[1].next_batch())


def test_pulses_are_dealt_equally_often():
    sampler = EpochSampler(numbered(7), 3, seed=5)
    counts = Counter(i for _ in range(2000) for i in numbers(sampler.next_batch()))
    # 6000 cards among 7: 857 each; the spread of a sampler's counts is below sqrt(857)
    assert max(abs(c - 6000 / 7) for c in counts.values()) < 4 * np.sqrt(6000 / 7)


@pytest.mark.thorough
@pytest.mark.parametrize(("n_sim", "n_data"), [(5, 7), (7, 5), (6, 6)])
def test_in_a_training_every_pulse_meets_every_other(monkeypatch, tiny, n_sim, n_data):
    pairs: Counter[tuple[int, int]] = Counter()

    class Watched(Step):
        def __call__(self, iteration, sim, data, rows):
            # data are numbered from 100, so that the sides cannot be taken for each other
            pairs.update(zip(numbers(sim), numbers(data), strict=True))
            return dict.fromkeys(LOSS_NAMES, torch.zeros(()))

    monkeypatch.setattr(loop, "Step", Watched)
    # expected 660 / 36 = 18 meetings of each pair
    recipe = tiny("training.iterations=165", "training.batch_size=4")
    sim, data = numbered(n_sim, 64)[:, 0].numpy(), 100 + numbered(n_data, 64)[:, 0].numpy()
    train(np.ascontiguousarray(sim), np.ascontiguousarray(data), recipe, seed=3)
    assert set(pairs) == {(i, 100 + j) for i in range(n_sim) for j in range(n_data)}
    assert max(pairs.values()) < 0.1 * sum(pairs.values())
