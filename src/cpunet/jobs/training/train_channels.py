"""Train on each channel of a file of data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cpunet.jobs.common.channels import Outcome, Pair, one_by_one, own_folder, paired
from cpunet.jobs.common.inputs import InputFile
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.training.train import train_run
from cpunet.recipes.schema import Recipe
from cpunet.training.loop import StoppedError
from cpunet.training.run_folder import INFO, read_info
from cpunet.training.unfinished import unfinished_name

QUIET = Monitor()


def train_channels(
    sim: InputFile,
    data: InputFile,
    out: Path,
    recipe: Recipe,
    *,
    init: Path | None = None,
    resume: bool = False,
    monitor: Monitor = QUIET,
    **options: Any,
) -> Outcome[dict[str, Any]]:
    """Train a run for each channel of the data, in the folder ``OUT/CHANNEL``.

    Parameters
    ----------
    sim, data
        Files; the table of the data is ``"all"``, that of the simulation may be.
    out
        Folder of the run folders.
    init
        A run to start from, or the folder of a run for each channel.
    resume
        Keep the runs that are there, and go on with those that are unfinished.
    monitor, options
        As for `cpunet.jobs.training.train.train_run`.

    Returns
    -------
    Outcome
        The content of each ``run.json``, and the reasons why channels have none.

    Raises
    ------
    CpunetError
        If the files cannot be read, or `out` is a run itself.
    StoppedError
        If it was asked to stop.
    """

    def train(name: str, pair: Pair, folder: Path) -> dict[str, Any]:
        if resume and (folder / INFO).is_file():
            monitor.note(f"{name}: trained already")
            return read_info(folder)
        return train_run(
            *pair,
            folder,
            recipe,
            init=None if init is None else own_folder(init, name, INFO),
            resume=resume and unfinished_name(folder).exists(),
            monitor=monitor,
            **options,
        )

    return one_by_one(paired(sim, data), out, train, monitor.note, StoppedError)
