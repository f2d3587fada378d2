"""`cpunet.train`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cpunet.jobs.training.train import train_run
from cpunet.jobs.training.training_job import TrainOptions
from cpunet.pulses.reading.files import Source, pulse_file
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.training.run import Run, RunLike


def train(
    sim: Source,
    data: Source,
    out: str | Path,
    *,
    recipe: str | Path | Recipe = "fast",
    settings: Mapping[str, Any] | None = None,
    peak: str = "FEP",
    seed: int = 0,
    device: str = "auto",
    init: RunLike | None = None,
    resume: bool = False,
    force: bool = False,
) -> Run:
    """Learn the translation from simulated and measured pulses, unpaired.

    Parameters
    ----------
    sim, data
        Simulated and measured pulses: a path, or `cpunet.PulseFile` with reading options.
    out
        Folder of the run; it appears when the training is done.
    recipe
        ``"fast"`` (a readout chain), ``"paper"`` (networks), a YAML file, or a
        `Recipe`.
    settings
        Values that override those of a named recipe, such as ``{"training.steps": 20}``.
    peak
        Energies to train on: a line, or ranges in keV, such as ``"FEP,1000-1580"``.
    seed
        Seed of all random numbers.
    device
        ``"cpu"``, ``"cuda"`` or ``"auto"``.
    init
        A run of another detector or period to start from.
    resume
        Whether to resume an unfinished training of a network.
    force
        Whether to replace an output that this program wrote earlier.

    Returns
    -------
    Run
        The trained run.

    Raises
    ------
    CpunetError
        If an argument cannot be used; the message is one line that says what to do.
    """
    return train_run(
        pulse_file(sim),
        pulse_file(data),
        Path(out),
        load_recipe(recipe, settings or ()),
        TrainOptions(peak, seed, device, init, resume, force),
    )
