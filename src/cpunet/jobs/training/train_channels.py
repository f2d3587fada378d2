"""Train a run for each channel of a data file."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from cpunet.jobs.training.train import train_run
from cpunet.jobs.training.training_job import TrainOptions
from cpunet.pulses.channels import Outcome, Pair, one_by_one, own_folder, paired
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import Recipe
from cpunet.training.checkpoints import unfinished_name
from cpunet.training.loop import StoppedError
from cpunet.training.run import INFO, Run

log = logging.getLogger(__name__)

AS_USUAL = TrainOptions()


def train_channels(
    sim: PulseFile,
    data: PulseFile,
    out: Path,
    recipe: Recipe,
    options: TrainOptions = AS_USUAL,
    *,
    stop: Callable[[], bool] = lambda: False,
) -> Outcome[Run]:
    """Train a run for each channel of the data, in the folder ``OUT/CHANNEL``.

    Parameters
    ----------
    sim, data
        Input files; the table of the data is ``"all"``, that of the simulation can be.
    out
        Folder of the run folders.
    options
        ``init`` can be a folder of runs by channel. ``resume`` keeps finished runs and resumes
        unfinished ones.
    stop
        See `cpunet.jobs.training.train.train_run`.

    Returns
    -------
    Outcome
        Each run, and the reasons why channels have none.

    Raises
    ------
    CpunetError
        If the files cannot be read, or `out` is a run itself.
    StoppedError
        If `stop` returned true.
    """

    def train(name: str, pair: Pair, folder: Path) -> Run:
        if options.resume and (folder / INFO).is_file():
            log.info(f"{name}: trained already")
            return Run.load(folder)
        init = options.init
        own = replace(
            options,
            init=own_folder(Path(init), name, INFO) if isinstance(init, str | Path) else init,
            resume=options.resume and unfinished_name(folder).exists(),
        )
        return train_run(*pair, folder, recipe, own, stop=stop)

    return one_by_one(paired(sim, data), out, train, StoppedError)
