"""The losses against their formulas, written out sample by sample."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cpunet.recipes import load_recipe
from cpunet.recipes.training_settings import LossConfig
from cpunet.training.cyclegan import fake_loss, real_loss, weighted_l1, window_weights

PAPER = load_recipe("paper").training.losses


def windows(lengths: tuple[int, int, int], weights: tuple[float, float, float]) -> LossConfig:
    names = ("baseline", "rising_edge", "tail")
    return PAPER.model_copy(
        update={f"{n}_len": v for n, v in zip(names, lengths, strict=True)}
        | {f"{n}_weight": v for n, v in zip(names, weights, strict=True)}
    )


def test_the_papers_windows():
    weights = window_weights(PAPER)
    assert weights.shape == (800,)
    expected = [3 / 200] * 200 + [10 / 250] * 250 + [7 / 350] * 350
    assert weights.tolist() == pytest.approx(expected)


@given(
    lengths=st.tuples(*[st.integers(1, 7)] * 3),
    weights=st.tuples(*[st.floats(0, 20)] * 3),
    n=st.integers(1, 4),
    seed=st.integers(0, 99),
)
def test_weighted_l1_sample_by_sample(lengths, weights, n, seed):
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.randn(2, n, 1, sum(lengths), generator=generator, dtype=torch.float64)
    total = 0.0
    for pulse in range(n):
        sample = 0
        for length, weight in zip(lengths, weights, strict=True):
            differences = 0.0
            for _ in range(length):
                differences += abs(float(a[pulse, 0, sample]) - float(b[pulse, 0, sample]))
                sample += 1
            total += weight * differences / length
    found = weighted_l1(a, b, window_weights(windows(lengths, weights)))
    assert float(found) == pytest.approx(total / n, rel=1e-5, abs=1e-12)


@given(st.lists(st.floats(-30, 30), min_size=1, max_size=5))
def test_cross_entropies(logits):
    # log(1 + exp(-x)) = -log(sigmoid(x))
    real = sum(math.log1p(math.exp(-x)) for x in logits) / len(logits)
    fake = sum(math.log1p(math.exp(x)) for x in logits) / len(logits)
    values = torch.tensor(logits, dtype=torch.float64)
    assert float(real_loss(values)) == pytest.approx(real)
    assert float(fake_loss(values)) == pytest.approx(fake)


def test_a_confident_error_is_finite():
    assert float(real_loss(torch.tensor([-1e4]))) == 1e4
    assert float(fake_loss(torch.tensor([1e4]))) == 1e4
