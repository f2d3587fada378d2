"""The loop: reproducible, logged, and stopped when a loss is no number."""

from __future__ import annotations

import copy
import signal
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from cpunet.errors import CpunetError
from cpunet.training import loop
from cpunet.training.cyclegan import Step
from cpunet.training.loop import (
    EpochSampler,
    discriminators_noted,
    refresh_batch_statistics,
    train,
)
from synthetic import LOSS_NAMES, interrupted_in


def test_the_global_random_state_is_left_alone(tiny, sets):
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    train(*sets, tiny(), seed=0)
    assert torch.equal(torch.get_rng_state(), before)
    assert (np.random.get_state()[1] == numpy_before).all()  # noqa: NPY002


def test_records_come_in_bunches_and_none_is_lost(tiny, sets):
    bunches = []
    recipe = tiny(
        "training.iterations=7", "training.log_interval=3", "training.discriminator_interval=2"
    )
    train(*sets, recipe, seed=0, listener=bunches.append)
    assert [len(bunch) for bunch in bunches] == [3, 3, 1]
    records = [record for bunch in bunches for record in bunch]
    assert [record["iteration"] for record in records] == list(range(7))
    for record in records:
        expected = LOSS_NAMES if record["iteration"] % 2 == 0 else LOSS_NAMES[:6]
        assert set(record["losses"]) == set(expected)
        judged = {"data", "sim"} if record["iteration"] % 2 == 0 else set()
        assert record.get("accuracy", {}).keys() == judged
        assert all(isinstance(v, float) and np.isfinite(v) for v in record["losses"].values())
    rate = recipe.training.rate_generators
    assert [record["rate"] for record in records] == pytest.approx(
        [rate, rate, rate, 0.8 * rate, 0.6 * rate, 0.4 * rate, 0.2 * rate]
    )


def test_the_first_bad_iteration_is_named(tiny, sets, monkeypatch):

    class Diverging(Step):
        def __call__(self, iteration, sim, data, rows):
            value = float("inf") if iteration >= 4 else 1.0
            return {"identity_sim": torch.tensor(value)}

    monkeypatch.setattr(loop, "Step", Diverging)
    with pytest.raises(CpunetError, match=r"identity_sim is inf in iteration 4 \(seed 0\);"):
        train(*sets, tiny("training.iterations=20", "training.log_interval=10"), seed=0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_training_on_a_gpu_goes_on(tiny, sets):
    states, recipe = [], tiny("training.checkpoint_interval=2")

    def save(state):
        states.append(copy.deepcopy(state))

    whole = train(*sets, recipe, seed=0, device="cuda", save=save).state_dict()
    again = train(*sets, recipe, seed=0, device="cuda", start=states[0]).state_dict()
    # cuDNN's kernels may add in another order
    for name, value in whole.items():
        torch.testing.assert_close(again[name], value, rtol=1e-3, atol=1e-4)


def kept(sets, recipe):
    """Train; numbers of iterations after which the state was kept, and of records by then."""
    records, states = [], []

    def save(state):
        states.append((state["iteration"], len(records)))

    try:
        train(*sets, recipe, seed=0, listener=records.extend, save=save)
    finally:
        assert [record["iteration"] for record in records] == [*range(len(records))]
    return states


def test_the_state_is_kept_at_its_interval_and_at_the_end(tiny, sets):
    recipe = tiny("training.iterations=5", "training.checkpoint_interval=2")
    # never before the listener has had all that led to it
    assert kept(sets, recipe) == [(2, 2), (4, 4), (5, 5)]


def test_an_interruption_is_kept(tiny, sets, caplog):
    caplog.set_level("INFO", "cpunet")
    before, states = signal.getsignal(signal.SIGINT), []

    def save(state):
        states.append(state["iteration"])

    with interrupted_in(3), pytest.raises(KeyboardInterrupt):
        train(*sets, tiny(), seed=0, save=save)
    assert states == [3]
    assert caplog.messages[-1].startswith("stopped after 3 of 4 iterations; resume")
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interruption_in_the_last_iteration_is_none(tiny, sets):
    with interrupted_in(1):
        assert kept(sets, tiny("training.iterations=1")) == [(1, 1)]


def test_a_thread_trains_without_signals(tiny, sets):
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(kept, sets, tiny("training.iterations=1")).result() == [(1, 1)]


def test_what_diverged_is_not_kept(tiny, sets, monkeypatch):

    class Diverging(Step):
        def __call__(self, iteration, sim, data, rows):
            if iteration == 3:  # its losses are still those of the weights before
                with torch.no_grad():
                    next(self.model.parameters())[:] = torch.nan
            return {"identity_sim": torch.zeros(())}

    monkeypatch.setattr(loop, "Step", Diverging)
    states = []
    recipe = tiny("training.iterations=20", "training.checkpoint_interval=2")

    def save(state):
        states.append(state["iteration"])

    with pytest.raises(
        CpunetError, match=r"diverged: .* is not finite after iteration 3 \(seed 8"
    ):
        train(*sets, recipe, seed=8, save=save)
    assert states == [2]


def records(*of_data: float) -> list:
    return [
        {"iteration": i, "rate": 1.0, "losses": {}, "accuracy": {"data": a, "sim": 0.7}}
        for i, a in enumerate(of_data)
    ]


@pytest.mark.parametrize(
    ("early", "late", "told"), [(0.7, 0.99, "won"), (0.7, 0.4, "lost"), (0.99, 0.7, None)]
)
def test_what_counts_is_the_end(early, late, told):
    lines = discriminators_noted(records(*[early] * 300, *[late] * 100))
    if told is None:
        assert lines == []
    else:
        (line,) = lines
        assert line.startswith(
            f"the discriminator of data has {told}: it is right {100 * late:.0f} %"
        )
        assert "\n" not in line


def test_few_updates_tell_nothing():
    assert discriminators_noted(records(*[1.0] * 10)) == []
    assert discriminators_noted([{"iteration": 0, "rate": 1.0, "losses": {}}]) == []


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


def test_pulses_are_dealt_equally_often():
    sampler = EpochSampler(numbered(7), 3, seed=5)
    counts = Counter(i for _ in range(2000) for i in numbers(sampler.next_batch()))
    # 6000 cards among 7: 857 each; the spread of a sampler's counts is below sqrt(857)
    assert max(abs(c - 6000 / 7) for c in counts.values()) < 4 * np.sqrt(6000 / 7)


def test_statistics_are_plain_averages_over_the_batches():
    pulses = torch.randn(12, 1, 7, generator=torch.Generator().manual_seed(0)) * 3 + 1
    network = nn.Sequential(nn.BatchNorm1d(1), nn.Conv1d(1, 2, 3), nn.BatchNorm1d(2)).eval()
    with torch.no_grad():
        network[0].weight.fill_(1.7)
        network(torch.full((2, 1, 7), 99.0))
    sampler, same_sampler = (EpochSampler(pulses, 4, seed=3) for _ in range(2))
    refresh_batch_statistics(network, sampler, 3)

    means, variances = ([], []), ([], [])
    for _ in range(3):
        x = same_sampler.next_batch()
        means[0].append(x.mean())
        variances[0].append(x.var())
        centred = (x - x.mean()) / torch.sqrt(x.var(correction=0) + network[0].eps)
        y = nn.functional.conv1d(1.7 * centred, network[1].weight, network[1].bias)
        means[1].append(y.mean(dim=(0, 2)))
        variances[1].append(y.var(dim=(0, 2)))
    for norm, mean, variance in zip((network[0], network[2]), means, variances, strict=True):
        expected = torch.stack(mean).mean(dim=0).detach().reshape(-1)
        torch.testing.assert_close(norm.running_mean, expected)
        expected = torch.stack(variance).mean(dim=0).detach().reshape(-1)
        torch.testing.assert_close(norm.running_var, expected)


def test_statistics_are_those_without_dropout():
    pulses = torch.randn(40, 1, 50, generator=torch.Generator().manual_seed(0)) + 5
    network = nn.Sequential(nn.Dropout(0.5), nn.BatchNorm1d(1)).eval()
    refresh_batch_statistics(network, EpochSampler(pulses, 40, seed=3), 1)
    torch.testing.assert_close(network[1].running_var, pulses.var().reshape(1))
    assert network[0].p == 0.5
    assert network(pulses).std().item() == pytest.approx(1, rel=1e-3)


def test_the_same_seed_gives_the_same_bits(tiny, sets):
    runs = []
    for before in (0, 99):  # what happened before does not matter
        torch.manual_seed(before)
        records = []
        model = train(*sets, tiny(), seed=5, listener=records.extend)
        runs.append((model.state_dict(), records))
    (first, told), (again, told_again) = runs
    assert all(torch.equal(first[name], value) for name, value in again.items())
    assert told == told_again
