"""The loop: reproducible, logged, and stopped when a loss is no number."""

from __future__ import annotations

import copy
import signal
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from cpunet.errors import CpunetError
from cpunet.training.loop import CheckpointHooks, train
from synthetic import LOSS_NAMES, interrupted_in


def run(sets, recipe, seed=0):
    records = []
    model = train(*sets, recipe, seed=seed, listener=records.extend)
    return model.state_dict(), records


def same(a, b) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_the_same_seed_gives_the_same_bits(tiny, sets):
    recipe = tiny("training.average_decay=0.5")
    first, records = run(sets, recipe, seed=5)
    torch.manual_seed(99)  # what happened before does not matter
    again, records_again = run(sets, recipe, seed=5)
    assert same(first, again)
    assert records == records_again


def test_another_seed_gives_other_weights_and_losses(tiny, sets):
    (a, records_a), (b, records_b) = (run(sets, tiny(), seed) for seed in (5, 6))
    assert not same(a, b)
    assert records_a != records_b


def test_the_global_random_state_is_left_alone(tiny, sets):
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    run(sets, tiny())
    assert torch.equal(torch.get_rng_state(), before)
    assert (np.random.get_state()[1] == numpy_before).all()  # noqa: NPY002


def test_the_input_is_left_alone(tiny, sets):
    before = [pulses.copy() for pulses in sets]
    run(sets, tiny())
    assert all(np.array_equal(a, b) for a, b in zip(before, sets, strict=True))


def test_records_come_in_bunches_and_none_is_lost(tiny, sets):
    bunches = []
    recipe = tiny(
        "training.iterations=7",
        "training.log_interval=3",
        "training.discriminator_interval=2",
    )
    train(*sets, recipe, seed=0, listener=bunches.append)
    assert [len(bunch) for bunch in bunches] == [3, 3, 1]
    records = [record for bunch in bunches for record in bunch]
    assert [record["iteration"] for record in records] == list(range(7))
    for record in records:
        expected = LOSS_NAMES if record["iteration"] % 2 == 0 else LOSS_NAMES[:6]
        assert set(record["losses"]) == set(expected)
        assert all(isinstance(v, float) and np.isfinite(v) for v in record["losses"].values())
    rate = recipe.training.rate_generators
    assert [record["rate"] for record in records] == pytest.approx(
        [rate, rate, rate, 0.8 * rate, 0.6 * rate, 0.4 * rate, 0.2 * rate]
    )


def test_the_result_is_ready_for_use(tiny, sets):
    model = train(*sets, tiny(), seed=0)
    assert not any(module.training for module in model.modules())


@pytest.mark.parametrize("side", [0, 1], ids=["sim", "data"])
@pytest.mark.parametrize("value", [np.nan, pytest.param(np.inf, marks=pytest.mark.thorough)])
def test_a_loss_that_is_no_number_stops_the_training(tiny, sets, side, value):
    sets[side][:, 20] = value
    with pytest.raises(CpunetError) as error:
        train(*sets, tiny(), seed=0)
    assert "training diverged" in str(error.value)
    assert "in iteration 0 (seed 0); lower the learning rates" in str(error.value)
    assert "\n" not in str(error.value)


def test_the_first_bad_iteration_is_named(tiny, sets, monkeypatch):
    from cpunet.training import loop
    from cpunet.training.cyclegan import Step

    class Diverging(Step):
        def __call__(self, iteration, sim, data, rows):
            value = float("inf") if iteration >= 4 else 1.0
            return {"identity_sim": torch.tensor(value)}

    monkeypatch.setattr(loop, "Step", Diverging)
    with pytest.raises(CpunetError, match=r"identity_sim is inf in iteration 4 \(seed 0\);"):
        train(*sets, tiny("training.iterations=20", "training.log_interval=10"), seed=0)


@pytest.mark.parametrize(("side", "name"), [(0, "simulated"), (1, "measured")])
def test_an_empty_set(tiny, sets, side, name):
    sets = [pulses[:0] if i == side else pulses for i, pulses in enumerate(sets)]
    with pytest.raises(CpunetError, match=f"no {name} pulses to train on"):
        train(*sets, tiny(), seed=0)


def test_a_single_pulse_on_each_side_is_enough(tiny, sets):
    weights, _ = run([pulses[:1] for pulses in sets], tiny())
    assert all(bool(torch.isfinite(value).all()) for value in weights.values())


def test_without_an_average_the_last_weights_are_kept(tiny, sets, monkeypatch):
    from cpunet.training import loop
    from cpunet.training.cyclegan import Step

    history = []

    class Watched(Step):
        def __call__(self, iteration, sim, data, rows):
            losses = super().__call__(iteration, sim, data)
            history.append([p.detach().clone() for p in self.model.ren.parameters()])
            return losses

    monkeypatch.setattr(loop, "Step", Watched)
    model = train(*sets, tiny("training.average_decay=0"), seed=0)
    assert all(map(torch.equal, model.ren.parameters(), history[-1]))

    history.clear()
    model = train(*sets, tiny("training.average_decay=0.6"), seed=0)
    expected = history[0]
    for weights in history[1:]:
        expected = [0.6 * e + 0.4 * w for e, w in zip(expected, weights, strict=True)]
    for kept, truth in zip(model.ren.parameters(), expected, strict=True):
        torch.testing.assert_close(kept.detach(), truth, rtol=1e-4, atol=1e-6)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("penalty", [0.0, 0.3])
def test_a_training_on_a_gpu(tiny, sets, penalty):
    before = torch.cuda.get_rng_state()
    recipe = tiny(f"training.losses.gradient_penalty={penalty}")
    model = train(*sets, recipe, seed=0, device="cuda")
    assert all(bool(torch.isfinite(value).all()) for value in model.state_dict().values())
    assert torch.equal(torch.cuda.get_rng_state(), before)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_training_on_a_gpu_goes_on(tiny, sets):
    states, recipe = [], tiny("training.checkpoint_interval=2")
    hooks = CheckpointHooks(lambda state: states.append(copy.deepcopy(state)))
    whole = train(*sets, recipe, seed=0, device="cuda", hooks=hooks).state_dict()
    hooks = CheckpointHooks(lambda _state: None, start=states[0])
    again = train(*sets, recipe, seed=0, device="cuda", hooks=hooks).state_dict()
    # cuDNN's kernels may add in another order
    for name, value in whole.items():
        torch.testing.assert_close(again[name], value, rtol=1e-3, atol=1e-4)


def kept(sets, recipe):
    """Train; numbers of iterations after which the state was kept, and of records by then."""
    records, states = [], []

    def save(state):
        states.append((state["iteration"], len(records)))

    try:
        train(
            *sets,
            recipe,
            seed=0,
            listener=records.extend,
            hooks=CheckpointHooks(save),
        )
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
    hooks = CheckpointHooks(lambda state: states.append(state["iteration"]))
    with interrupted_in(3), pytest.raises(KeyboardInterrupt):
        train(*sets, tiny(), seed=0, hooks=hooks)
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
    from cpunet.training import loop
    from cpunet.training.cyclegan import Step

    class Diverging(Step):
        def __call__(self, iteration, sim, data, rows):
            if iteration == 3:  # its losses are still those of the weights before
                with torch.no_grad():
                    next(self.model.parameters())[:] = torch.nan
            return {"identity_sim": torch.zeros(())}

    monkeypatch.setattr(loop, "Step", Diverging)
    states = []
    recipe = tiny("training.iterations=20", "training.checkpoint_interval=2")
    hooks = CheckpointHooks(lambda state: states.append(state["iteration"]))
    with pytest.raises(
        CpunetError, match=r"diverged: .* is not finite after iteration 3 \(seed 8"
    ):
        train(*sets, recipe, seed=8, hooks=hooks)
    assert states == [2]
