"""Train on two files of pulses and write a run folder."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np

from cpunet.errors import CpunetError
from cpunet.jobs.training.check import Level, compare_sides
from cpunet.jobs.training.cyclegan_trainer import train_networks
from cpunet.jobs.training.response_trainer import train_chain
from cpunet.jobs.training.training_job import TrainingJob, TrainOptions
from cpunet.matrices import one_thread_for_matrices
from cpunet.memory import keep_freed_memory
from cpunet.outputs import folder_written_aside
from cpunet.pulses.loading import (
    InputSet,
    load_measured,
    load_simulated,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import Recipe
from cpunet.training.checkpoints import unfinished_folder
from cpunet.training.devices import resolve_device
from cpunet.training.run import RUN, Run, as_run

log = logging.getLogger(__name__)

AS_USUAL = TrainOptions()
FITS: dict[str, Callable[[TrainingJob], Run]] = {
    "matching": train_chain,
    "cyclegan": train_networks,
}


@one_thread_for_matrices()
def train_run(
    sim: PulseFile,
    data: PulseFile,
    out: Path,
    recipe: Recipe,
    options: TrainOptions = AS_USUAL,
    *,
    stop: Callable[[], bool] = lambda: False,
) -> Run:
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
    Run
        The trained run.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists, there is an unfinished training of
        another kind, or the training diverges.
    StoppedError
        If `stop` returned true.
    """
    keep_freed_memory()
    init = None if options.init is None else as_run(options.init)
    options = replace(options, device=resolve_device(options.device))
    selection = parse_selection(options.peak, recipe.peaks)
    read = (*sim.files, *data.files, None if init is None else init.folder)
    with _workplace(out, read, recipe, options) as folder:
        sim_set, data_set = _read(sim, data, recipe, selection)
        if init is not None:
            _require_sampling(init, data_set)
        job = TrainingJob(recipe, options, sim_set, data_set, data, init, folder, stop)
        run = FITS[recipe.training.method](job)
        run.write(folder)
    return run.model_copy(update={"folder": out})


def _workplace(
    out: Path, read: Sequence[Path | str | None], recipe: Recipe, options: TrainOptions
) -> AbstractContextManager[Path]:
    """Context of the folder to write to, which becomes `out` when the training is complete."""
    resume, force = options.resume, options.force
    if recipe.training.method == "cyclegan":
        return unfinished_folder(out, *read, resume=resume, force=force)
    if resume:
        raise CpunetError(
            f"recipe {recipe.name}: takes a minute and keeps no checkpoints; give the "
            "recipe that the training was begun with, or leave out --resume"
        )
    return folder_written_aside(out, RUN, *read, force=force)


def _read(
    sim: PulseFile,
    data: PulseFile,
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


def _require_sampling(init: Run, data: InputSet) -> None:
    """Raise a `CpunetError` if the run to start from has another sampling period."""
    if not np.isclose(init.dt_ns, data.dt_ns):
        kinds = f"trained on {init.dt_ns:g} ns, these pulses have {data.dt_ns:g} ns"
        raise CpunetError(f"{init.name}: {kinds}; resample them")
