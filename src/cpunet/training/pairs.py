"""Supervised steps on pairs of simulated pulses and their translations by a matched chain.

A matched chain makes any number of pairs of charge pulses and translated pulses, with or
without noise.  REN learns the translation without noise, IREN the way back from the one with
noise.  A REN that follows the chain has nothing to learn from it.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR

from cpunet.errors import CpunetError
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.recipes.schema import Recipe
from cpunet.training.chain_step import ChainStep
from cpunet.training.cyclegan import CycleGan
from cpunet.training.losses import weighted_l1, window_weights
from cpunet.training.outside import Outside, as_measured, of_height
from cpunet.training.process_group import ALONE, ProcessGroup
from cpunet.training.sampling import EpochSampler
from cpunet.training.surroundings import Surroundings


def learn_pairs(
    model: CycleGan,
    sampler: EpochSampler,
    recipe: Recipe,
    surroundings: Surroundings,
    behind: ChainStep | None,
    group: ProcessGroup = ALONE,
) -> None:
    """Train the generators on pairs, if there is a chain or a teacher to make them.

    Parameters
    ----------
    model
        Networks; only the generators are trained.
    sampler
        Sampler of simulated pulses.
    recipe
        Recipe; ``training.pairs`` sets the number of iterations and the learning rate.
    surroundings
        Noise, and a teacher if there is one.
    behind
        Passes with a chain, if there is one.
    group
        Process group, each process with its share of the pairs.

    Raises
    ------
    CpunetError
        If a loss is not finite.
    """
    outside, teacher = surroundings.outside, surroundings.teacher
    if (behind is None or outside is None) and teacher is None:
        return
    config = recipe.cyclegan.training
    weights = window_weights(config.losses).to(sampler.pulses.device)
    learning = model.generator_parameters() if behind is None else [*model.iren.parameters()]
    optimiser = AdamW(learning, lr=config.pairs.rate, weight_decay=config.weight_decay)
    schedule = LambdaLR(optimiser, lambda done: 1 - done / config.pairs.iterations)
    for iteration in range(config.pairs.iterations):
        sim = sampler.next_batch()
        if behind is not None and outside is not None:
            loss = weighted_l1(*behind.pairs(sim, sampler.last_rows, outside), weights)
        else:
            assert teacher is not None
            loss = _of_teacher(model, sim, sampler.last_rows, *teacher, weights)
        if group.any(not bool(torch.isfinite(loss))):
            raise CpunetError(
                f"pairs: a loss is not finite in iteration {iteration}; lower "
                "training.pairs.rate"
            )
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        group.average_gradients(learning)
        torch.nn.utils.clip_grad_norm_(learning, config.max_grad_norm)
        optimiser.step()
        schedule.step()


def _of_teacher(
    model: CycleGan,
    sim: Tensor,
    rows: Tensor,
    teacher: ResponseGenerator,
    outside: Outside,
    weights: Tensor,
) -> Tensor:
    """Loss of both generators on pairs of a batch."""
    config = outside.preparation
    with torch.no_grad():
        records = of_height(teacher(sim[:, 0]), config.tail_level)
        clean = as_measured(records, config, outside.noise.dt_ns).windows
        noisy = outside.dress(records, rows).windows
    to_data = weighted_l1(model.ren(sim), clean, weights)
    return to_data + weighted_l1(model.iren(noisy), sim, weights)
