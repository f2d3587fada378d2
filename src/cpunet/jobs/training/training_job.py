"""A training: its recipe, pulses, options and folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from cpunet.jobs.training.chain_and_inverse import Sides
from cpunet.pulses.loading import InputSet
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import Recipe
from cpunet.training.devices import peak_memory_mb
from cpunet.training.run import Run, RunLike, versions


@dataclass(frozen=True)
class TrainOptions:
    """How to train, see `cpunet.jobs.training.train.train_run`.

    Parameters
    ----------
    peak
        Energies to train on: a peak of the recipe or a range in keV.
    seed
        Seed of all random numbers.
    device
        ``"cpu"``, ``"cuda"``, or ``"auto"`` for a GPU if there is one.
    init
        A run of the same kind to start from, e.g. of another detector or period.
    resume
        Whether to resume an unfinished training, if any; all else must be unchanged.
    force
        Whether to replace an existing folder and, without `resume`, an unfinished training.
    """

    peak: str = "FEP"
    seed: int = 0
    device: str = "auto"
    init: RunLike | None = None
    resume: bool = False
    force: bool = False


@dataclass(frozen=True, eq=False)
class TrainingJob:
    """All inputs of a training.

    Parameters
    ----------
    options
        Options with a resolved device.
    sim, data, data_file
        Prepared pulses of both sides, and the file of the measured ones.
    init
        Run to start from.
    folder
        Folder to write to.
    stop
        Called after each iteration of a CycleGAN; returns whether to store its state and stop.
    """

    recipe: Recipe
    options: TrainOptions
    sim: InputSet
    data: InputSet
    data_file: PulseFile
    init: Run | None
    folder: Path
    stop: Callable[[], bool] = lambda: False

    @property
    def sides(self) -> Sides:
        """Pulses of both sides."""
        return Sides(
            self.sim.prepared.pulses, self.data.prepared.pulses, self.data_file, self.data
        )

    def run(
        self, model: nn.Module, recipe: Recipe, started: str, seconds: float, **more: Any
    ) -> Run:
        """The run of trained networks.

        Parameters
        ----------
        model
            Module with ``ren`` and ``iren``.
        recipe
            Recipe as trained; ringing may have been added to its chain.
        started, seconds
            When the training began, and the time that it took.
        more
            Further facts of the run.
        """
        how = self.options
        return Run.of(
            model,
            recipe,
            peak=how.peak,
            seed=how.seed,
            init=None if self.init is None else self.init.name,
            device=how.device,
            threads=torch.get_num_threads(),
            started=started,
            seconds=round(seconds, 1),
            peak_memory_mb=peak_memory_mb(how.device),
            dt_ns=self.data.dt_ns,
            versions=versions(),
            sim=self.sim.provenance(),
            data=self.data.provenance(),
            **more,
        )
