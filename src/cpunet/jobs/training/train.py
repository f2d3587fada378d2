"""Train on two files of pulses and write a run folder."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import (
    InputFile,
    InputSet,
    load_measured,
    load_simulated,
    require_both_sides,
    require_same_sampling,
)
from cpunet.jobs.common.matrices import one_thread_for_matrices
from cpunet.jobs.common.memory import keep_freed_memory
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.training.check import Level, compare_sides
from cpunet.jobs.training.launched_group import group_for
from cpunet.jobs.training.trainers import trainer_for
from cpunet.jobs.training.training_job import TrainingJob, TrainOptions
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.training.run_folder import read_info, write_run

QUIET, AS_USUAL = Monitor(), TrainOptions()


@one_thread_for_matrices()
def train_run(
    sim: InputFile,
    data: InputFile,
    out: Path,
    recipe: Recipe,
    options: TrainOptions = AS_USUAL,
    *,
    stop: Callable[[], bool] = lambda: False,
    monitor: Monitor = QUIET,
) -> dict[str, Any]:
    """Train REN and IREN on the pulses of a peak and write the run folder.

    Processes that torchrun started train one CycleGAN together; the one of rank 0 writes.

    Parameters
    ----------
    sim, data
        Simulated and measured pulses.
    out
        Run folder; it appears when it is complete. Until then a CycleGAN writes to
        ``OUT.unfinished``, see `cpunet.training.unfinished`.
    stop
        Called after each iteration of a CycleGAN; returns whether to store its state and stop.
    monitor
        Receiver of the progress.

    Returns
    -------
    dict
        Content of ``run.json``; empty in a process that did not write it.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists, there is an unfinished training of
        another kind, the training diverges or another process fails.
    StoppedError
        If `stop` returned true.
    """
    keep_freed_memory()
    trainer = trainer_for(recipe)
    with group_for(trainer, options.device) as (group, device):
        selection = parse_selection(options.peak, recipe.peaks)
        told = monitor if group.leads else QUIET
        read = (*sim.files, *data.files, options.init)
        place: AbstractContextManager[Path] = nullcontext(out)
        if group.leads:  # the others do not write
            place = trainer.workplace(out, read, options)
        with place as folder:
            sim_set, data_set = _read(sim, data, recipe, selection, told)
            if options.init is not None:
                _require_sampling(options.init, data_set)
            how = replace(options, device=device)
            job = TrainingJob(recipe, how, group, sim_set, data_set, data, folder, told, stop)
            done = trainer.train(job)
            if done is None:
                return {}
            return write_run(folder, done.model, done.recipe, done.info)


def _read(
    sim: InputFile,
    data: InputFile,
    recipe: Recipe,
    selection: EnergySelection,
    monitor: Monitor,
) -> tuple[InputSet, InputSet]:
    """Read and prepare both sides, and warn of what makes a training on them doubtful."""
    sim_set = load_simulated(sim, recipe, selection, monitor)
    data_set = load_measured(data, recipe, selection, monitor)
    require_same_sampling(sim_set, data_set)
    require_both_sides(sim_set, data_set, selection)
    for finding in compare_sides(sim_set, data_set, selection):
        if finding.level != Level.FINE:
            monitor.note(f"warning: {finding}")
    return sim_set, data_set


def _require_sampling(init: Path, data: InputSet) -> None:
    """Raise a `CpunetError` if the run to start from has another sampling period."""
    known_ns = float(read_info(init)["dt_ns"])
    if not np.isclose(known_ns, data.dt_ns):
        kinds = f"trained on {known_ns:g} ns, these pulses have {data.dt_ns:g} ns"
        raise CpunetError(f"{init}: {kinds}; resample them")
