"""Two files in, a run folder with trained networks out."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.jobs.common.devices import enough_memory
from cpunet.jobs.common.inputs import (
    InputFile,
    InputSet,
    load_measured,
    load_simulated,
    require_both_sides,
    require_same_sampling,
)
from cpunet.jobs.common.memory import keep_freed_memory
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.training.check import Level, compare_sides
from cpunet.jobs.training.launched_group import group_for
from cpunet.jobs.training.trainers import trainer_for
from cpunet.jobs.training.training_job import TrainingJob
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.training.run_folder import read_info, write_run

QUIET = Monitor()


def train_run(
    sim: InputFile,
    data: InputFile,
    out: Path,
    recipe: Recipe,
    *,
    peak: str = "FEP",
    seed: int = 0,
    device: str = "auto",
    init: Path | None = None,
    resume: bool = False,
    force: bool = False,
    tensorboard: bool = False,
    stop: Callable[[], bool] = lambda: False,
    monitor: Monitor = QUIET,
) -> dict[str, Any]:
    """Train REN and IREN on the pulses of a peak and write the run folder.

    Processes that torchrun started train one CycleGAN together; the one of rank 0 writes.

    Parameters
    ----------
    out
        The run folder; it appears when the training is done. A CycleGAN works in
        ``OUT.unfinished`` until then, see `cpunet.training.unfinished`.
    peak
        Energies to train on: a peak of the recipe or a range in keV.
    init
        Folder of a run to start from, as of another detector or period: of the same kind, or
        a matched one, which makes pairs for networks to learn first.
    resume
        Resume an unfinished training, if there is one; all else must be unchanged.
    tensorboard
        Write TensorBoard logs beside the losses (needs the extra ``tensorboard``).
    stop
        Asked after each iteration of a CycleGAN whether to store its state and stop.

    Returns
    -------
    dict
        The content of ``run.json``; empty in a process that did not write it.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists, there is an unfinished training of
        another kind, memory does not suffice, the training diverges or another process fails.
    StoppedError
        If `stop` asked for it.
    """
    keep_freed_memory()
    trainer = trainer_for(recipe)
    with group_for(trainer, device) as (group, device):
        selection = parse_selection(peak, recipe.peaks)
        told = monitor if group.leads else QUIET
        read = (*sim.files, *data.files, init)
        place: AbstractContextManager[Path] = nullcontext(out)
        if group.leads:  # the others do not write
            place = trainer.workplace(out, read, resume=resume, force=force, note=told.note)
        with place as folder:
            sim_set = load_simulated(sim, recipe, selection, told)
            data_set = load_measured(data, recipe, selection, told)
            require_same_sampling(sim_set, data_set)
            for note in require_both_sides(sim_set, data_set, selection):
                told.note(note)
            for finding in compare_sides(sim_set, data_set, selection):
                if finding.level != Level.FINE:
                    told.note(f"warning: {finding}")
            if init is not None:
                _require_sampling(init, data_set)
            sides = sim_set, data_set, data
            job = TrainingJob(recipe, peak, seed, device, group, init, *sides, folder, told)
            with enough_memory(trainer.less_memory(group.size)):
                done = trainer.train(job, resume=resume, tensorboard=tensorboard, stop=stop)
            if done is None:
                return {}
            return write_run(folder, done.model, done.recipe, done.info)


def _require_sampling(init: Path, data: InputSet) -> None:
    """Raise a `CpunetError` if the run to start from had another sampling."""
    known_ns = float(read_info(init)["dt_ns"])
    if not np.isclose(known_ns, data.dt_ns):
        kinds = f"trained on {known_ns:g} ns, these pulses have {data.dt_ns:g} ns"
        raise CpunetError(f"{init}: {kinds}; resample them")
