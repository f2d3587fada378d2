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


class Trainer(Protocol):
    """A training method for a recipe."""

    def workplace(
        self,
        out: Path,
        read: Sequence[Path | str | None],
        options: TrainOptions,
    ) -> AbstractContextManager[Path]:
        """Context of the folder to write to; see `cpunet.jobs.training.train.train_run`."""

    def train(self, job: TrainingJob) -> Trained:
        """Train or resume."""


def trainer_for(recipe: Recipe) -> Trainer:
    """Return the training method of a recipe."""
    if isinstance(recipe.training, MatchingConfig):
        return ResponseTrainer(recipe)
    return CycleGanTrainer(recipe)
