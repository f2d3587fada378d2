"""Supervised steps on pairs of simulated pulses and their translations by a matched chain.

A matched chain makes any number of pairs of charge pulses and translated pulses, with or
without noise.  REN learns the translation without noise, IREN the way back from the one with
noise.  A REN that follows the chain has nothing to learn from it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR

from cpunet.errors import CpunetError
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.recipes.schema import Recipe
from cpunet.training.chain_step import ChainStep
from cpunet.training.cyclegan import CycleGan, load_optimiser
from cpunet.training.losses import weighted_l1, window_weights
from cpunet.training.outside import Outside, as_measured, of_height
from cpunet.training.sampling import EpochSampler
from cpunet.training.surroundings import Surroundings


class Pairs:
    """Supervised steps of the generators on pairs, if there is a chain or a teacher.

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
    """

    def __init__(
        self,
        model: CycleGan,
        sampler: EpochSampler,
        recipe: Recipe,
        surroundings: Surroundings,
        behind: ChainStep | None,
    ) -> None:
        config = recipe.cyclegan.training
        self.model, self.sampler = model, sampler
        self.surroundings, self.behind = surroundings, behind
        self.max_grad_norm = config.max_grad_norm
        self.count = number_of_pairs(recipe, surroundings)
        self.iteration = 0
        self.weights = window_weights(config.losses).to(sampler.pulses.device)
        own = model.generator_parameters() if behind is None else [*model.iren.parameters()]
        self.learning = own
        self.optimiser = AdamW(own, lr=config.pairs.rate, weight_decay=config.weight_decay)
        self.schedule = LambdaLR(self.optimiser, self._falling)

    @property
    def left(self) -> int:
        """Number of iterations still to be done."""
        return self.count - self.iteration

    def advance(self) -> None:
        """Do an iteration.

        Raises
        ------
        CpunetError
            If the loss is not finite.
        """
        loss = self._loss()
        if not bool(torch.isfinite(loss)):
            raise CpunetError(
                f"pairs: a loss is not finite in iteration {self.iteration}; lower "
                "training.pairs.rate"
            )
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.learning, self.max_grad_norm)
        self.optimiser.step()
        self.schedule.step()
        self.iteration += 1

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next iterations depend on, except networks and sampler."""
        return {
            "iteration": self.iteration,
            "optimiser": self.optimiser.state_dict(),
            "schedule": self.schedule.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of steps with the same settings."""
        self.iteration = state["iteration"]
        load_optimiser(self.optimiser, state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])

    def skip(self) -> None:
        """Do no more iterations, and free the memory of the optimiser."""
        self.iteration = self.count
        self.optimiser.state.clear()

    def _falling(self, done: int) -> float:
        return 1 - done / max(1, self.count)

    def _loss(self) -> Tensor:
        sim, rows = self.sampler.next_batch(), self.sampler.last_rows
        outside, teacher = self.surroundings.outside, self.surroundings.teacher
        if self.behind is not None and outside is not None:
            return weighted_l1(*self.behind.pairs(sim, rows, outside), self.weights)
        assert teacher is not None
        return _of_teacher(self.model, sim, rows, *teacher, self.weights)


def number_of_pairs(recipe: Recipe, surroundings: Surroundings) -> int:
    """Number of iterations on pairs: none without something that makes them."""
    behind = surroundings.chain is not None and surroundings.outside is not None
    taught = behind or surroundings.teacher is not None
    return recipe.cyclegan.training.pairs.iterations if taught else 0


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
