"""`cpunet.train`: two files of pulses become a run."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs
from cpunet.pulses.channels import Outcome, each_channel, paired
from cpunet.pulses.reading.files import ALL, ReadOptions, Source

if TYPE_CHECKING:
    from cpunet.recipes.schema import Recipe
    from cpunet.training.run import Run
else:  # as the command line reads them
    Recipe, Run = str, Any

log = logging.getLogger(__name__)


def train(
    sim: Source,
    data: Source,
    out: str | Path | None = None,
    *,
    recipe: str | Path | Recipe = "fast",
    settings: Sequence[str] | Mapping[str, Any] = (),
    peak: str = "FEP",
    seed: int = 0,
    device: str = "auto",
    resume: bool = False,
    read: ReadOptions = ReadOptions(),
    force: bool = False,
) -> Run | Outcome[Run]:
    """Train REN and IREN on simulated and measured pulses, unpaired.

    Ends with status 1 if the fit is bad; the run is written all the same.

    Parameters
    ----------
    sim
        Simulated pulses; of all channels, as ``sim/{channel}.lh5``.
    data
        Measured pulses.
    out
        Run folder to make; it appears when it is complete. Networks are trained in
        ``OUT.unfinished`` until then.
    recipe
        ``fast`` (a readout), ``cpunet`` (and networks), ``paper``, ``published`` (networks
        alone), or a YAML file.
    settings
        Override a value of the recipe, as ``training.batch_size=64`` (repeatable).
    peak
        Energies to train on: FEP, SEP, DEP or a range in keV, as ``300-``, or several.
    seed
        Seed of all random numbers.
    device
        cpu, cuda, or auto: the GPU if present.
    resume
        Resume OUT.unfinished; give all other options as before. Chains are fitted anew.
    read
        How the files are read, if they do not tell themselves. All channels of the data
        become runs in the folders ``OUT/CHANNEL``, in a process for each core.
    force
        Replace existing output.

    Returns
    -------
    Run or Outcome
        The trained run; of all channels, each run or the reason why it failed. Its ``ok``
        says whether its fit is good.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists, an unfinished training is of
        another kind, or the training diverges.

    Examples
    --------
    ``cpunet train --sim sim.lh5 --data raw.lh5 --out run``

    ``cpunet train --recipe paper --sim sim.lh5 --data raw.lh5 --out run --resume``

    ``cpunet train --sim sim.lh5 --data raw.lh5 --data-table all --out runs``
    """
    # imported late: this takes a second, and the help of the command must not wait for it
    from cpunet.recipes import load_recipe
    from cpunet.recipes.schema import Recipe
    from cpunet.settings import require_seed
    from cpunet.training.job import trained_in
    from cpunet.training.run import resolve_device

    target = None if out is None else Path(out)
    if target is not None and not isinstance(recipe, Recipe):
        refuse_inputs(target, recipe)
    require_seed(seed)
    chosen = load_recipe(recipe, settings)
    device = resolve_device(device, chosen)
    sides = read.files(sim, data)

    how: dict[str, Any] = {"force": force, "recipe": chosen, "peak": peak, "seed": seed}
    how |= {"device": device, "resume": resume}
    trained: Run | Outcome[Run]
    of_all = ["--data-table", ALL] if sides[1].table == ALL else []
    if not of_all:
        trained = trained_in("", sides, target, **how)
    elif target is None:
        raise CpunetError("`out`: runs of all channels do not stay in memory", "give a folder")
    else:
        trained = each_channel(paired(*sides), target, partial(trained_in, **how))
    if target is not None and all(side.pulses is None for side in sides):
        words: list[object] = ["--sim", sides[0].path, "--data", sides[1].path, *of_all]
        if trained.ok:
            report = target.with_name(f"{target.name}-report")
            words = ["validate", target, *words, "--out", report]
        else:
            log.warning(f"{target}: written, though bad; whatever uses it will say so")
            words = ["check", *words]
        log.info(f"next: {shlex.join(map(str, ['cpunet', *words]))}")
    return trained
