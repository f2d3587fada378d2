"""The training loop: batch, step, log, checkpoint, and stop if a loss is not finite.

One step is in `cpunet.training.cyclegan`.  In the end, generators get batch-norm statistics of
the side that each of them translates.
"""

from __future__ import annotations

import logging
import math
import signal
import threading
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import update_bn

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.recipes.schema import Recipe
from cpunet.training.cyclegan import CycleGan, Outside, Step
from cpunet.training.run import Record

log = logging.getLogger(__name__)

Listener = Callable[[list[Record]], None]
# dicts and lists of tensors, numbers and text; has "iteration"
State = dict[str, Any]

LAST = 0.25  # last fraction of the updates, over which accuracies are averaged
MIN_UPDATES = 20  # minimum number of updates
WON, LOST = 0.95, 0.52  # accuracy of a discriminator from which a generator learns nothing


def train(
    sim: FloatArray,
    data: FloatArray,
    recipe: Recipe,
    *,
    seed: int,
    device: str = "cpu",
    init: Callable[[CycleGan], None] | None = None,
    outside: Outside | None = None,
    listener: Listener | None = None,
    save: Callable[[State], None] | None = None,
    start: State | None = None,
) -> CycleGan:
    """Train REN and IREN on two unpaired sets of prepared pulses.

    The same seed on the same computer results in the same weights, whether or not the training
    was interrupted and resumed.  Ctrl-C and SIGTERM act between two iterations, once the state
    is saved; a second one acts at once.

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
        Fills the networks with initial weights, instead of random ones.
    outside
        Noise outside the generators, if the recipe requires it.
    listener
        Called every ``log_interval`` iterations, and before each state is saved, with the
        records since the last call: ``{"iteration": i, "rate": r, "losses": {name: value}}``,
        and ``"accuracy"`` of the discriminators where they were updated.
    save
        Called with the state every ``checkpoint_interval`` iterations, after the last one and
        before an interruption, always after the listener has received all earlier records.
        The tensors change again once it returns.
    start
        State to continue from.

    Raises
    ------
    CpunetError
        If a loss becomes NaN or infinite.
    """
    config = recipe.cyclegan.training
    cuda = [torch.device(device)] if device.startswith("cuda") else []
    with torch.random.fork_rng(devices=cuda):  # which restores the random state
        torch.manual_seed(seed)
        model = CycleGan(recipe, outside).to(device).train()
        # far apart, so that neighbouring seeds share no sampler
        seeds = 2 * seed + 1_000_003, 2 * seed + 2_000_004
        samplers = [
            EpochSampler(torch.from_numpy(pulses)[:, None].to(device), config.batch_size, own)
            for pulses, own in zip((sim, data), seeds, strict=True)
        ]
        if start is None and init is not None:
            init(model)
        warmup = 0 if init is None else config.warmup
        step = Step(model, config, outside=outside, warmup=warmup)
        training = _Training(step, samplers, device, seed)
        if start is not None:
            training.load_state_dict(start)
        training.run(listener, save)
        for network, sampler in zip((model.ren, model.iren), samplers, strict=True):
            refresh_batch_statistics(network, sampler, config.statistics_batches)
    return model.eval()


class EpochSampler:
    """Batches of a set of pulses without replacement, reshuffled when too few are left.

    Each side has its own, so no simulated pulse is tied to one measured pulse, and the surplus
    of the larger set is not thrown away.  Sets smaller than a batch are drawn with replacement.
    """

    def __init__(self, pulses: Tensor, batch_size: int, seed: int) -> None:
        self.pulses = pulses
        self.batch_size = batch_size
        self._random = torch.Generator().manual_seed(seed)
        self._order = torch.empty(0, dtype=torch.long)
        self.last_rows = torch.empty(0, dtype=torch.long)
        """Rows of the pulses of the last batch."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return the rows still to be drawn and the state of the random numbers."""
        return {"order": self._order.clone(), "random": self._random.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the state of a sampler of the same pulses."""
        self._order = state["order"]
        self._random.set_state(state["random"])

    def next_batch(self) -> Tensor:
        """Return the next batch, shape (batch, 1, samples)."""
        n = len(self.pulses)
        if n < self.batch_size:
            chosen = torch.randint(n, (self.batch_size,), generator=self._random)
        else:
            if len(self._order) < self.batch_size:
                self._order = torch.randperm(n, generator=self._random)
            chosen = self._order[: self.batch_size]
            self._order = self._order[self.batch_size :]
        self.last_rows = chosen
        return self.pulses[chosen.to(self.pulses.device)]


def refresh_batch_statistics(network: nn.Module, sampler: EpochSampler, batches: int) -> None:
    """Replace the running statistics of all batch norms by averages over one side's pulses.

    In training a generator sees pulses of both sides (identity and cycle losses).  For one side
    alone, the running averages of both shift the tail slope of a translation by more than its
    spread (Wu and Johnson 2021, arXiv:2105.07576, section 3).  Dropout is off meanwhile, as in
    a translation: it raises the variance at the batch norms behind it, here by up to a sixth
    (Li et al. 2019, CVPR, "variance shift").
    """
    # `update_bn` switches every module to training mode
    layers = [module for module in network.modules() if isinstance(module, nn.Dropout)]
    fractions = [layer.p for layer in layers]
    for layer in layers:
        layer.p = 0.0
    update_bn((sampler.next_batch() for _ in range(batches)), network)
    for layer, fraction in zip(layers, fractions, strict=True):
        layer.p = fraction


def discriminators_noted(records: Sequence[Record]) -> list[str]:
    """One line for each discriminator that has won or lost in the last part of a training."""
    told = [a for record in records if isinstance(a := record.get("accuracy"), dict)]
    last = told[-max(1, round(LAST * len(told))) :]
    if len(last) < MIN_UPDATES:
        return []
    lines = []
    for side in last[0]:
        mean = float(np.mean([accuracy[side] for accuracy in last]))
        if mean > WON:
            lines.append(
                f"the discriminator of {side} has won: it is right {100 * mean:.0f} % of the "
                "time, so translations are still easily distinguished; train longer or lower "
                "training.rate_discriminators"
            )
        elif mean < LOST:
            lines.append(
                f"the discriminator of {side} has lost: it is right {100 * mean:.0f} % of the "
                "time, so it finds nothing to teach; the scores tell whether anything is left"
            )
    return lines


class _Iteration(NamedTuple):
    """What came of an iteration: its losses, and the accuracies of discriminators updated."""

    number: int
    rate: float
    losses: dict[str, Tensor]
    accuracy: dict[str, Tensor]

    def record(self, seed: int) -> Record:
        """The same in numbers, if all losses are finite."""
        losses, accuracy = (
            {name: float(value) for name, value in part.items()} for part in self[2:]
        )
        for name, value in losses.items():
            if not math.isfinite(value):
                raise _diverged(f"{name} is {value} in iteration {self.number}", seed)
        told: Record = {"iteration": self.number, "rate": self.rate, "losses": losses}
        return told | ({"accuracy": accuracy} if accuracy else {})


class _Training:
    """Everything that changes from iteration to iteration."""

    def __init__(
        self, step: Step, samplers: list[EpochSampler], device: str, seed: int
    ) -> None:
        self.step, self.samplers, self.config, self.seed = step, samplers, step.config, seed
        self.model = step.model
        self.device = torch.device(device)
        self.parts: dict[str, Sequence[Any]] = {
            "optimisers": step.optimisers,
            "schedules": step.schedules,
            "decks": samplers,
        }
        self.iteration = 0  # number of completed iterations

    def advance(self) -> _Iteration:
        """Do an iteration."""
        iteration, rate = self.iteration, float(self.step.schedules[0].get_last_lr()[0])
        sim, data = (sampler.next_batch() for sampler in self.samplers)
        losses = self.step(iteration, sim, data, self.samplers[0].last_rows)
        self.iteration += 1
        return _Iteration(iteration, rate, losses, self.step.accuracy)

    def run(self, listener: Listener | None, save: Callable[[State], None] | None) -> None:
        """Do all iterations that are left, or those until it is interrupted."""
        config = self.config
        pending: list[_Iteration] = []
        with _Interruption() as interruption:
            while self.iteration < config.iterations:
                pending.append(self.advance())
                done = self.iteration
                last = done == config.iterations
                stop = 0 if last else interruption.signal
                keep = last or stop or done % config.checkpoint_interval == 0
                # several iterations are fetched at once: each transfer makes a GPU wait
                if keep or len(pending) == config.log_interval:
                    records = [one.record(self.seed) for one in pending]
                    pending.clear()
                    if listener is not None:
                        listener(records)
                if keep and save is not None:
                    # losses are one iteration behind the weights
                    for name, value in self.model.state_dict().items():
                        if not bool(torch.isfinite(value).all()):
                            told = f"{name} is not finite after iteration {done - 1}"
                            raise _diverged(told, self.seed)
                    save(self.state_dict())
                if stop:
                    log.info(
                        f"stopped after {done} of {config.iterations} iterations; resume goes "
                        "on from there"
                    )
                    signal.raise_signal(stop)

    def state_dict(self) -> State:
        """Return all that the next iterations depend on, except pulses and settings."""
        random = {"cpu": torch.get_rng_state()}
        if self.device.type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(self.device)
        return {
            "iteration": self.iteration,
            "model": self.model.state_dict(),
            "random": random,
        } | {name: [part.state_dict() for part in parts] for name, parts in self.parts.items()}

    def load_state_dict(self, state: State) -> None:
        """Restore the state of a training with the same pulses and settings."""
        self.iteration = state["iteration"]
        self.model.load_state_dict(state["model"])
        for name, parts in self.parts.items():
            for part, own in zip(parts, state[name], strict=True):
                part.load_state_dict(own)
        torch.set_rng_state(state["random"]["cpu"])
        if self.device.type == "cuda" and "cuda" in state["random"]:
            torch.cuda.set_rng_state(state["random"]["cuda"], self.device)


class _Interruption:
    """Ctrl-C and SIGTERM wait for the end of an iteration; a second one acts at once."""

    def __init__(self) -> None:
        self.signal = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # others get no signals
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, number: int, _frame: FrameType | None) -> None:
        self.__exit__()
        self.signal = number
        log.info("stopping after this iteration; once more to stop at once")


def _diverged(told: str, seed: int) -> CpunetError:
    remedy = "lower the learning rates or change the seed, and begin again"
    return CpunetError(f"training diverged: {told} (seed {seed}); {remedy}")
