"""A training: its recipe, pulses, options and folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import nn

from cpunet.jobs.common.devices import peak_memory_mb
from cpunet.jobs.common.inputs import InputFile, InputSet
from cpunet.jobs.training.chain_and_inverse import Sides
from cpunet.recipes.schema import Recipe
from cpunet.training.run_folder import versions


class Trained(NamedTuple):
    """Result of a training.

    Parameters
    ----------
    model
        Module with ``ren`` and ``iren``.
    info
        Content of ``run.json``.
    recipe
        Recipe as trained; ringing may have been added to its chain.
    """

    model: nn.Module
    info: dict[str, Any]
    recipe: Recipe


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
        Folder of a run of the same kind to start from, e.g. of another detector or period.
    resume
        Whether to resume an unfinished training, if any; all else must be unchanged.
    force
        Whether to replace an existing folder and, without `resume`, an unfinished training.
    """

    peak: str = "FEP"
    seed: int = 0
    device: str = "auto"
    init: Path | None = None
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
    folder
        Folder to write to.
    stop
        Called after each iteration of a CycleGAN; returns whether to store its state and stop.
    """

    recipe: Recipe
    options: TrainOptions
    sim: InputSet
    data: InputSet
    data_file: InputFile
    folder: Path
    stop: Callable[[], bool] = lambda: False

    @property
    def sides(self) -> Sides:
        """Pulses of both sides."""
        return Sides(
            self.sim.prepared.pulses, self.data.prepared.pulses, self.data_file, self.data
        )

    def info(self, started: str, seconds: float) -> dict[str, Any]:
        """Provenance of a run, for ``run.json``; `seconds` is the time that it took."""
        how = self.options
        return {
            "recipe": self.recipe.name,
            "peak": how.peak,
            "seed": how.seed,
            "init": None if how.init is None else str(how.init),
            "device": how.device,
            "threads": torch.get_num_threads(),
            "started": started,
            "seconds": round(seconds, 1),
            "peak_memory_mb": peak_memory_mb(how.device),
            "dt_ns": self.data.dt_ns,
            "versions": versions(),
            "sim": self.sim.provenance(),
            "data": self.data.provenance(),
        }
