"""Training methods, one class each."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from cpunet.jobs.training.cyclegan_trainer import CycleGanTrainer
from cpunet.jobs.training.response_trainer import ResponseTrainer
from cpunet.jobs.training.training_job import Trained, TrainingJob, TrainOptions
from cpunet.recipes.schema import Recipe
from cpunet.recipes.training_settings import MatchingConfig
from cpunet.training.process_group import ProcessGroup


class Trainer(Protocol):
    """A training method for a recipe."""

    def require_shareable(self, group: ProcessGroup) -> None:
        """Raise a `CpunetError` if several processes cannot train the recipe together."""

    def workplace(
        self,
        out: Path,
        read: Sequence[Path | str | None],
        options: TrainOptions,
    ) -> AbstractContextManager[Path]:
        """Context of the folder to write to; see `cpunet.jobs.training.train.train_run`."""

    def train(self, job: TrainingJob) -> Trained | None:
        """Train or resume; return None in a process that does not write."""


def trainer_for(recipe: Recipe) -> Trainer:
    """Return the training method of a recipe."""
    if isinstance(recipe.training, MatchingConfig):
        return ResponseTrainer(recipe)
    return CycleGanTrainer(recipe)
