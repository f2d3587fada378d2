"""A training: its recipe, its pulses, and where it writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from cpunet.pulses.loading import InputSet
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import Recipe
from cpunet.training.devices import peak_memory_mb
from cpunet.training.fit import Sides
from cpunet.training.pulse_sets import Continuum
from cpunet.training.run import Run, versions


@dataclass(frozen=True, eq=False)
class TrainingJob:
    """All inputs of a training.

    Parameters
    ----------
    recipe, peak, seed, device
        Settings, energies, seed, and the device to train on.
    sim, data, data_file
        Prepared pulses of both sides, and the file of the measured ones.
    folder
        Folder to write to.
    init
        Run to start from.
    resume
        Whether a training of networks is to be resumed.
    continuum
        Reads the pulses of both sides away from all lines.
    """

    recipe: Recipe
    peak: str
    seed: int
    device: str
    sim: InputSet
    data: InputSet
    data_file: PulseFile
    folder: Path
    init: Run | None = None
    resume: bool = False
    continuum: Continuum | None = None

    @property
    def sides(self) -> Sides:
        """Pulses of both sides."""
        sim, data = self.sim.prepared.pulses, self.data.prepared.pulses
        return Sides(sim, data, self.data_file, self.data, self.continuum)

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
        return Run.of(
            model,
            recipe,
            peak=self.peak,
            seed=self.seed,
            init=None if self.init is None else self.init.name,
            device=self.device,
            threads=torch.get_num_threads(),
            started=started,
            seconds=round(seconds, 1),
            peak_memory_mb=peak_memory_mb(self.device),
            dt_ns=self.data.dt_ns,
            versions=versions(),
            sim=self.sim.provenance(),
            data=self.data.provenance(),
            **more,
        )
