"""The training loop: batch, step, log, checkpoint, and stop if a loss is not finite."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.recipes.schema import Recipe
from cpunet.training.chain_step import ChainStep
from cpunet.training.cyclegan import CycleGan, Step
from cpunet.training.pairs import Pairs
from cpunet.training.sampling import EpochSampler
from cpunet.training.start import match_skips
from cpunet.training.statistics import refresh_batch_statistics
from cpunet.training.surroundings import NONE, Surroundings

Record = dict[str, float | int | dict[str, float]]
Listener = Callable[[list[Record]], None]
Entry = tuple[int, float, dict[str, Tensor], dict[str, Tensor]]
# dicts and lists of tensors, numbers and text; has "iteration", and "pairs" while these last
State = dict[str, Any]


class StoppedError(CpunetError):
    """A training was stopped early on request, after saving its state."""


@dataclass(frozen=True)
class CheckpointHooks:
    """Hooks to save and resume a training.

    Parameters
    ----------
    save
        Called with the state every ``checkpoint_interval`` iterations, after the last one and
        before a stop, always after the listener has received all earlier records; on the way
        through `pairs` as well.  The tensors change again once it returns.
    start
        State to continue from.
    stop
        Called after each iteration; True to stop there.
    paired
        Called with the number of iterations on pairs since the last call.
    """

    save: Callable[[State], None]
    start: State | None = None
    stop: Callable[[], bool] = lambda: False
    paired: Callable[[int], None] = lambda _steps: None


NOTHING_KEPT = CheckpointHooks(lambda _state: None)


def train(
    sim: FloatArray,
    data: FloatArray,
    recipe: Recipe,
    *,
    seed: int,
    device: str = "cpu",
    init: Callable[[CycleGan], None] | None = None,
    surroundings: Surroundings = NONE,
    listener: Listener | None = None,
    hooks: CheckpointHooks = NOTHING_KEPT,
) -> CycleGan:
    """Train REN and IREN on two unpaired sets of prepared pulses.

    The same seed on the same computer results in the same weights, whether or not the training
    was interrupted and resumed.

    Parameters
    ----------
    sim, data
        Prepared pulses, shapes (n, samples) and (n', samples).
    recipe
        Networks and training settings.
    seed
        Seed of the initial weights, the order of the pulses, dropout and latent noise.
    device
        ``"cpu"``, ``"cuda"``, or one of several GPUs.
    init
        Fills the networks with initial weights, instead of the closed-form start.
    surroundings
        Noise outside the generators, a chain before them, a teacher; as the recipe requires.
    listener
        Called every ``log_interval`` iterations, and before each state is saved, with the
        records since the last call: ``{"iteration": i, "rate": r, "losses": {name: value}}``,
        and ``"accuracy"`` of the discriminators where they were updated.
    hooks
        Hooks to save and resume the training, and to stop it.

    Raises
    ------
    CpunetError
        If a set is empty, or a loss becomes NaN or infinite.
    StoppedError
        If `hooks` asked to stop.
    """
    for name, pulses in (("simulated", sim), ("measured", data)):
        if not len(pulses):
            raise CpunetError(f"no {name} pulses to train on")
    config = recipe.cyclegan.training
    with _seeded(seed, device):
        model = CycleGan(recipe, surroundings).to(device).train()
        behind = None
        if surroundings.chain is not None:
            behind = ChainStep(*surroundings.chain, model.ren, model.iren, recipe)
        samplers = [
            EpochSampler(torch.from_numpy(pulses)[:, None].to(device), config.batch_size, side)
            for side, pulses in zip(_sampler_seeds(seed), (sim, data), strict=True)
        ]
        if hooks.start is None:
            _begin(model, samplers, recipe, behind, init)
        step = Step(
            model,
            config,
            outside=surroundings.outside,
            chain=behind,
            warmup=0 if init is None and surroundings.teacher is None else config.warmup,
        )
        pairs = Pairs(model, samplers[0], recipe, surroundings, behind)
        training = _Training(step, samplers, device, pairs)
        if hooks.start is not None:
            training.load_state_dict(hooks.start)
        try:
            if training.iteration == 0:
                _learn_pairs(training, hooks)
            _iterate(training, listener, hooks)
        except _DivergenceError as error:
            raise CpunetError(
                f"training diverged: {error} (seed {seed}); lower the learning rates or change "
                "the seed, and begin again"
            ) from error
        training.take_averages()
        runs = (None, None) if behind is None else (behind.records, behind.iren)
        for network, sampler, run in zip((model.ren, model.iren), samplers, runs, strict=True):
            refresh_batch_statistics(network, sampler, config.statistics_batches, run)
    return model.eval()


def _begin(
    model: CycleGan,
    samplers: list[EpochSampler],
    recipe: Recipe,
    behind: ChainStep | None,
    init: Callable[[CycleGan], None] | None,
) -> None:
    """Initialise the generators: from given weights or in closed form."""
    if init is not None:
        init(model)
    elif behind is None:
        sim, data = (sampler.pulses for sampler in samplers)
        match_skips(model, sim, data, recipe.preparation.samples_before)


class _DivergenceError(Exception):
    """A loss or weight is not finite; the message says which and when."""


class _Training:
    """Everything that changes from iteration to iteration."""

    def __init__(
        self, step: Step, samplers: list[EpochSampler], device: str, pairs: Pairs
    ) -> None:
        self.step, self.samplers, self.pairs = step, samplers, pairs
        self.model, self.config = step.model, step.config
        self.device = torch.device(device)
        model, config = self.model, self.config
        average = get_ema_multi_avg_fn(config.average_decay)  # type: ignore[no-untyped-call]
        self.generators = (model.ren, model.iren)
        self.averages = [AveragedModel(g, multi_avg_fn=average) for g in self.generators]
        self.iteration = 0  # number of completed iterations

    def advance(self) -> Entry:
        """Do an iteration; return its number, learning rate, losses and accuracies."""
        iteration, rate = self.iteration, float(self.step.schedules[0].get_last_lr()[0])
        batches = [sampler.next_batch() for sampler in self.samplers]
        rows = () if self.step.outside is None else (self.samplers[0].last_rows,)
        losses = self.step(iteration, *batches, *rows)
        for averaged, network in zip(self.averages, self.generators, strict=True):
            averaged.update_parameters(network)
        self.iteration += 1
        return iteration, rate, losses, self.step.accuracy

    def take_averages(self) -> None:
        """Give the generators their averaged weights."""
        for averaged, network in zip(self.averages, self.generators, strict=True):
            network.load_state_dict(averaged.module.state_dict())

    def state_dict(self) -> State:
        """Return all that the next iterations depend on, except pulses and settings."""
        random = {"cpu": torch.get_rng_state()}
        if self.device.type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(self.device)
        pairs = {} if self.iteration else {"pairs": self.pairs.state_dict()}
        return pairs | {
            "iteration": self.iteration,
            "model": self.model.state_dict(),
            "averages": [averaged.state_dict() for averaged in self.averages],
            "step": self.step.state_dict(),
            "decks": [sampler.state_dict() for sampler in self.samplers],
            "random": random,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore the state of a training with the same pulses and settings."""
        self.iteration = state["iteration"]
        if "pairs" in state:
            self.pairs.load_state_dict(state["pairs"])
        else:
            self.pairs.skip()
        self.model.load_state_dict(state["model"])
        for averaged, own in zip(self.averages, state["averages"], strict=True):
            averaged.load_state_dict(own)
        self.step.load_state_dict(state["step"])
        for sampler, own in zip(self.samplers, state["decks"], strict=True):
            sampler.load_state_dict(own)
        random = state["random"]
        torch.set_rng_state(random["cpu"])
        if self.device.type == "cuda" and "cuda" in random:
            torch.cuda.set_rng_state(random["cuda"], self.device)


def _learn_pairs(training: _Training, hooks: CheckpointHooks) -> None:
    """Do the supervised steps that are left, if there are any."""
    pairs, interval = training.pairs, training.config.checkpoint_interval
    while pairs.left:
        pairs.advance()
        hooks.paired(1)
        stop = hooks.stop()
        if stop or pairs.iteration % interval == 0:
            _save(training, hooks)
        if stop:
            raise StoppedError(
                f"stopped after {pairs.iteration} of {pairs.count} iterations on pairs; "
                "continue with --resume"
            )
    pairs.skip()


def _save(training: _Training, hooks: CheckpointHooks) -> None:
    _require_finite_weights(training)
    hooks.save(training.state_dict())


def _iterate(training: _Training, listener: Listener | None, hooks: CheckpointHooks) -> None:
    config = training.config
    pending: list[Entry] = []
    while training.iteration < config.iterations:
        pending.append(training.advance())
        done = training.iteration
        last = done == config.iterations
        stop = hooks.stop() and not last
        keep = last or stop or done % config.checkpoint_interval == 0
        # several iterations are fetched at once: each transfer makes a GPU wait
        if keep or len(pending) == config.log_interval:
            records = [_record(*entry) for entry in pending]
            pending.clear()
            _require_finite(records)
            if listener is not None:
                listener(records)
        if keep:
            _save(training, hooks)
        if stop:
            raise StoppedError(
                f"stopped after {done} of {config.iterations} iterations; "
                "continue with --resume"
            )


def _record(
    iteration: int, rate: float, losses: dict[str, Tensor], accuracy: dict[str, Tensor]
) -> Record:
    told: Record = {
        "iteration": iteration,
        "rate": rate,
        "losses": {name: float(value) for name, value in losses.items()},
    }
    if accuracy:
        told["accuracy"] = {side: float(value) for side, value in accuracy.items()}
    return told


def _require_finite(records: list[Record]) -> None:
    for record in records:
        losses = record["losses"]
        assert isinstance(losses, dict)
        for name, value in losses.items():
            if not math.isfinite(value):
                raise _DivergenceError(f"{name} is {value} in iteration {record['iteration']}")


def _require_finite_weights(training: _Training) -> None:
    """Do not save a state with non-finite weights: losses are one iteration behind them."""
    for name, value in training.model.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            done, on_pairs = training.iteration, training.pairs.iteration
            where = f"iteration {done - 1}" if done else f"iteration {on_pairs - 1} on pairs"
            raise _DivergenceError(f"{name} is not finite after {where}")


def _sampler_seeds(seed: int) -> Iterator[int]:
    # far apart, so that neighbouring seeds share no sampler
    yield from (2 * seed + 1_000_003, 2 * seed + 2_000_004)


@contextmanager
def _seeded(seed: int, device: str) -> Iterator[None]:
    """Seed torch inside the context, and restore its random state afterwards."""
    cuda = [torch.device(device)] if device.startswith("cuda") else []
    with torch.random.fork_rng(devices=cuda):
        torch.manual_seed(seed)
        yield
