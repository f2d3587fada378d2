"""A training: its recipe, its pulses, and where it writes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import nn

from cpunet.errors import CpunetError
from cpunet.matrices import one_thread_for_matrices
from cpunet.memory import keep_freed_memory
from cpunet.outputs import folder_written_aside
from cpunet.pulses.channels import Pair, own_folder
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import (
    InputSet,
    load_pulses,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.training.check import Level, compare_sides
from cpunet.training.devices import peak_memory_mb
from cpunet.training.fit import train_chain
from cpunet.training.moments import MIN_PULSES
from cpunet.training.networks import train_networks, unfinished_folder, unfinished_name
from cpunet.training.pulse_sets import Continuum, continuum
from cpunet.training.run import INFO, RUN, Run, RunLike, as_run, read_losses, versions

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class TrainingJob:
    """All inputs of a training.

    Parameters
    ----------
    recipe, peak, seed, device
        Settings, energies, seed, and the device to train on.
    sim, data
        Prepared pulses of both sides.
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
    folder: Path
    init: Run | None = None
    resume: bool = False
    continuum: Continuum | None = None

    def trained(self, out: Path | None) -> Run:
        """Train, and write the folder of the job, which becomes `out`."""
        keep_freed_memory()
        fits: dict[str, Callable[[TrainingJob], Run]] = {
            "matching": train_chain,
            "cyclegan": train_networks,
        }
        with one_thread_for_matrices():
            run = fits[self.recipe.training.method](self)
        run.write(self.folder)
        run = run.model_copy(update={"folder": out})
        vars(run)["records"] = read_losses(self.folder)  # the folder moves, or goes
        return run

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


def _continuum(pair: Pair, recipe: Recipe, away: EnergySelection) -> tuple[Pulses, Pulses]:
    """Pulses of both sides away from all lines, read when a fit needs them."""
    sim = load_pulses(pair[0], "simulated", recipe, away, tell=False)
    data = load_pulses(pair[1], "measured", recipe, away, tell=False)
    return sim.prepared.pulses, data.prepared.pulses


@dataclass(frozen=True)
class Training:
    """How to train, whatever the pulses; see `cpunet.train`."""

    recipe: Recipe
    peak: str
    init: RunLike | None
    seed: int
    device: str
    resume: bool
    force: bool

    def of_channel(self, name: str, pair: Pair, folder: Path) -> Path:
        """The folder of the run of a channel, trained in a process of its own."""
        if self.resume and (folder / INFO).is_file():
            log.info(f"{name}: trained already")
            return folder
        init = self.init
        if isinstance(init, str | Path):
            init = own_folder(Path(init), name, INFO)
        start = None if init is None else as_run(init)
        go_on = self.resume and unfinished_name(folder).exists()
        self.run(pair, folder, start, go_on=go_on)
        return folder

    def run(self, pair: Pair, out: Path | None, start: Run | None, *, go_on: bool) -> Run:
        """Read, train and write a run."""
        files = (*pair[0].files, *pair[1].files, None if start is None else start.folder)
        with workplace(out, files, self.recipe, go_on, self.force) as folder:
            return self._job(pair, Path(folder), start, go_on).trained(out)

    def _job(self, pair: Pair, folder: Path, init: Run | None, resume: bool) -> TrainingJob:
        """Read and prepare both sides, and warn of what makes a training on them doubtful."""
        recipe, selection = self.recipe, parse_selection(self.peak, self.recipe.peaks)
        sim = load_pulses(pair[0], "simulated", recipe, selection)
        data = load_pulses(pair[1], "measured", recipe, selection)
        require_same_sampling(sim, data)
        require_both_sides(sim, data, selection)
        for finding in compare_sides(sim, data, selection):
            if finding.level != Level.FINE:
                log.warning(finding)
        away, beside = continuum(recipe), None
        there = min(int(away.select(side.energies_kev).sum()) for side in (sim, data))
        if there >= MIN_PULSES and not selection.ranges_kev:
            beside = partial(_continuum, pair, recipe, away)
        if init is not None and not np.isclose(init.dt_ns, data.dt_ns):
            kinds = f"trained on {init.dt_ns:g} ns, these pulses have {data.dt_ns:g} ns"
            raise CpunetError(f"{init.name}: {kinds}; resample them")
        return TrainingJob(
            recipe, self.peak, self.seed, self.device, sim, data, folder, init, resume, beside
        )


def workplace(
    out: Path | None,
    read: Sequence[Path | str | None],
    recipe: Recipe,
    resume: bool,
    force: bool,
) -> AbstractContextManager[Path | str]:
    """Context of the folder to write to, which becomes `out` when the training is complete."""
    networks = recipe.training.method == "cyclegan"
    if resume and (out is None or not networks):
        why = "takes a minute and keeps no checkpoints" if out else "was kept in memory only"
        raise CpunetError(
            f"recipe {recipe.name}: {why}",
            "give what the training was begun with, or leave out `resume`",
        )
    if out is None:
        return TemporaryDirectory()
    if networks:
        return unfinished_folder(out, *read, resume=resume, force=force)
    return folder_written_aside(out, RUN, *read, force=force)
