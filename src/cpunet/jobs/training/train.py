"""Train on two files of pulses and write a run folder."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.jobs.common.devices import resolve_device
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
from cpunet.jobs.training.check import Level, compare_sides
from cpunet.jobs.training.trainers import trainer_for
from cpunet.jobs.training.training_job import TrainingJob, TrainOptions
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.training.run_folder import read_info, write_run

log = logging.getLogger(__name__)

AS_USUAL = TrainOptions()


@one_thread_for_matrices()
def train_run(
    sim: InputFile,
    data: InputFile,
    out: Path,
    recipe: Recipe,
    options: TrainOptions = AS_USUAL,
    *,
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Train REN and IREN on the pulses of a peak and write the run folder.

    Parameters
    ----------
    sim, data
        Simulated and measured pulses.
    out
        Run folder; it appears when it is complete. Until then a CycleGAN writes to
        ``OUT.unfinished``, see `cpunet.training.checkpoints`.
    stop
        Called after each iteration of a CycleGAN; returns whether to store its state and stop.

    Returns
    -------
    dict
        Content of ``run.json``.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists, there is an unfinished training of
        another kind, or the training diverges.
    StoppedError
        If `stop` returned true.
    """
    keep_freed_memory()
    trainer = trainer_for(recipe)
    options = replace(options, device=resolve_device(options.device))
    selection = parse_selection(options.peak, recipe.peaks)
    read = (*sim.files, *data.files, options.init)
    with trainer.workplace(out, read, options) as folder:
        sim_set, data_set = _read(sim, data, recipe, selection)
        if options.init is not None:
            _require_sampling(options.init, data_set)
        job = TrainingJob(recipe, options, sim_set, data_set, data, folder, stop)
        done = trainer.train(job)
        return write_run(folder, done.model, done.recipe, done.info)


def _read(
    sim: InputFile,
    data: InputFile,
    recipe: Recipe,
    selection: EnergySelection,
) -> tuple[InputSet, InputSet]:
    """Read and prepare both sides, and warn of what makes a training on them doubtful."""
    sim_set = load_simulated(sim, recipe, selection)
    data_set = load_measured(data, recipe, selection)
    require_same_sampling(sim_set, data_set)
    require_both_sides(sim_set, data_set, selection)
    for finding in compare_sides(sim_set, data_set, selection):
        if finding.level != Level.FINE:
            log.warning(finding)
    return sim_set, data_set


def _require_sampling(init: Path, data: InputSet) -> None:
    """Raise a `CpunetError` if the run to start from has another sampling period."""
    known_ns = float(read_info(init)["dt_ns"])
    if not np.isclose(known_ns, data.dt_ns):
        kinds = f"trained on {known_ns:g} ns, these pulses have {data.dt_ns:g} ns"
        raise CpunetError(f"{init}: {kinds}; resample them")
