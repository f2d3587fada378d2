"""The training loop: deal, step, log, and stop when a loss is no longer a number."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.recipes.schema import Recipe
from cpunet.training.cyclegan import CycleGan, Step
from cpunet.training.sampling import Deck
from cpunet.training.start import match_skips
from cpunet.training.statistics import refresh_batch_statistics

Record = dict[str, float | int | dict[str, float]]
Listener = Callable[[list[Record]], None]


def train(
    sim: FloatArray,
    data: FloatArray,
    recipe: Recipe,
    *,
    seed: int,
    device: str = "cpu",
    listener: Listener | None = None,
) -> CycleGan:
    """Train REN and IREN on two unpaired sets of prepared pulses.

    The same seed on the same machine gives the same weights.

    Parameters
    ----------
    sim, data
        Prepared pulses, shapes (n, samples) and (n', samples).
    recipe
        Networks and training settings.
    seed
        Of the initial weights, the dealing of batches, dropout and latent noise.
    device
        ``"cpu"`` or ``"cuda"``.
    listener
        Called every ``log_interval`` iterations with the records since the last
        call: ``{"iteration": i, "rate": r, "losses": {name: value}}``.

    Raises
    ------
    CpunetError
        If a set is empty or a loss becomes NaN or infinite.
    """
    for name, pulses in (("simulated", sim), ("measured", data)):
        if not len(pulses):
            raise CpunetError(f"no {name} pulses to train on")
    config = recipe.cyclegan.training
    with _seeded(seed, device):
        model = CycleGan(recipe).to(device).train()
        decks = [
            Deck(torch.from_numpy(pulses)[:, None].to(device), config.batch_size, seed=side)
            for side, pulses in zip(_deck_seeds(seed), (sim, data), strict=True)
        ]
        match_skips(model, decks[0].pulses, decks[1].pulses, recipe.preparation.samples_before)
        _iterate(model, decks, recipe, listener)
        refresh_batch_statistics(model.ren, decks[0], config.statistics_batches)
        refresh_batch_statistics(model.iren, decks[1], config.statistics_batches)
    return model.eval()


def _iterate(
    model: CycleGan, decks: list[Deck], recipe: Recipe, listener: Listener | None
) -> None:
    config = recipe.cyclegan.training
    step = Step(model, config)
    average = get_ema_multi_avg_fn(config.average_decay)  # type: ignore[no-untyped-call]
    averages = [
        AveragedModel(network, multi_avg_fn=average) for network in (model.ren, model.iren)
    ]
    pending: list[tuple[int, float, dict[str, Tensor]]] = []
    for iteration in range(config.iterations):
        rate = float(step.schedules[0].get_last_lr()[0])
        losses = step(iteration, decks[0].deal(), decks[1].deal())
        for averaged, network in zip(averages, (model.ren, model.iren), strict=True):
            averaged.update_parameters(network)
        pending.append((iteration, rate, losses))
        last = iteration + 1 == config.iterations
        # values are fetched in bunches: each fetch makes a GPU wait
        if last or len(pending) == config.log_interval:
            records = [_record(*entry) for entry in pending]
            pending.clear()
            _require_finite(records)
            if listener is not None:
                listener(records)
    for averaged, network in zip(averages, (model.ren, model.iren), strict=True):
        network.load_state_dict(averaged.module.state_dict())


def _record(iteration: int, rate: float, losses: dict[str, Tensor]) -> Record:
    return {
        "iteration": iteration,
        "rate": rate,
        "losses": {name: float(value) for name, value in losses.items()},
    }


def _require_finite(records: list[Record]) -> None:
    for record in records:
        losses = record["losses"]
        assert isinstance(losses, dict)
        for name, value in losses.items():
            if not math.isfinite(value):
                raise CpunetError(
                    f"training diverged: {name} is {value} in iteration "
                    f"{record['iteration']}; lower the learning rates or change the seed"
                )


def _deck_seeds(seed: int) -> Iterator[int]:
    # far apart, so that neighbouring seeds share no deck
    yield from (2 * seed + 1_000_003, 2 * seed + 2_000_004)


@contextmanager
def _seeded(seed: int, device: str) -> Iterator[None]:
    """Seed torch inside, and leave its state outside as it was."""
    cuda = [torch.device(device)] if device.startswith("cuda") else []
    with torch.random.fork_rng(devices=cuda):
        torch.manual_seed(seed)
        yield
