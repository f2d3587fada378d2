"""`cpunet.train`: two files of pulses become a run."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.matrices import one_thread_for_matrices
from cpunet.memory import keep_freed_memory
from cpunet.outputs import folder_written_aside, refuse_inputs
from cpunet.pulses.channels import ALL, Outcome, Pair, one_by_one, own_folder, paired
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import (
    load_pulses,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.pulses.reading.files import PulseFile, ReadOptions, Source, pulse_file
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.settings import require_seed
from cpunet.training.chain import train_chain
from cpunet.training.check import Level, compare_sides
from cpunet.training.checkpoints import unfinished_folder, unfinished_name
from cpunet.training.devices import resolve_device
from cpunet.training.energy_bands import continuum
from cpunet.training.job import TrainingJob
from cpunet.training.moments import MIN_N
from cpunet.training.networks import train_networks
from cpunet.training.run import INFO, RUN, Run, RunLike, as_run, read_losses

log = logging.getLogger(__name__)

FITS: dict[str, Callable[[TrainingJob], Run]] = {
    "matching": train_chain,
    "cyclegan": train_networks,
}


def train(
    sim: Source,
    data: Source,
    out: str | Path | None = None,
    *,
    recipe: str | Path | Recipe = "fast",
    settings: Sequence[str] | Mapping[str, Any] = (),
    peak: str = "FEP",
    init: RunLike | None = None,
    seed: int = 0,
    device: str = "auto",
    resume: bool = False,
    read: ReadOptions = ReadOptions(),
    force: bool = False,
) -> Run | Outcome[Run]:
    """Train REN and IREN on simulated and measured pulses, unpaired.

    Parameters
    ----------
    sim
        Simulated pulses.
    data
        Measured pulses.
    out
        Run folder to make; it appears when it is complete. Networks are trained in
        ``OUT.unfinished`` until then.
    recipe
        ``fast`` (a readout chain), ``cpunet``, ``paper`` (networks), or a YAML file.
    settings
        Override a value of the recipe, as ``training.batch_size=64`` (repeatable).
    peak
        Energies to train on: FEP, SEP, DEP or a range in keV, as ``300-``, or several.
    init
        Run of the same kind to start from, as of another detector or period.
    seed
        Seed of all random numbers.
    device
        cpu, cuda, or auto: the GPU if there is one.
    resume
        Resume OUT.unfinished; give all other options as before.
    read
        How the files are read, if they do not tell themselves. All channels of the data,
        one after another, become runs in the folders ``OUT/CHANNEL``.
    force
        Replace existing output.

    Returns
    -------
    Run or Outcome
        The trained run; of all channels, each run or the reason why there is none.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists, there is an unfinished training of
        another kind, or the training diverges.

    Examples
    --------
    ``cpunet train --sim sim.lh5 --data raw.lh5 --out run``

    ``cpunet train --recipe paper --sim sim.lh5 --data raw.lh5 --out run --resume``

    ``cpunet train --sim sim.lh5 --data raw.lh5 --data-table all --out runs``
    """
    target = None if out is None else Path(out)
    if target is not None and not isinstance(recipe, Recipe):
        refuse_inputs(target, recipe)
    require_seed(seed)
    chosen, device = load_recipe(recipe, settings), resolve_device(device)
    sides = pulse_file(sim, read.sim), pulse_file(data, read.data)

    def one(pair: Pair, place: Path | None, start: RunLike | None, go_on: bool) -> Run:
        known = None if start is None else as_run(start)
        files = (*pair[0].files, *pair[1].files, None if known is None else known.folder)
        with _workplace(place, files, chosen, go_on, force) as folder:
            job = _job(pair, folder, chosen, peak, known, seed, device, go_on)
            return _trained(job, place)

    if sides[1].table != ALL:
        run = one(sides, target, init, resume)
        _tell_next(*sides, target)
        return run
    if target is None:
        raise CpunetError("`out`: runs of all channels are not kept in memory", "give a folder")

    def channel(name: str, pair: Pair, folder: Path) -> Run:
        if resume and (folder / INFO).is_file():
            log.info(f"{name}: trained already")
            return Run.load(folder)
        start = own_folder(Path(init), name, INFO) if isinstance(init, str | Path) else init
        return one(pair, folder, start, resume and unfinished_name(folder).exists())

    runs = one_by_one(paired(*sides), target, channel)
    _tell_next(*sides, target)
    return runs


def _tell_next(sim: PulseFile, data: PulseFile, out: Path | None) -> None:
    """Say how to validate runs of files."""
    if out is None or sim.pulses is not None or data.pulses is not None:
        return
    words = ["cpunet", "validate", out, "--sim", sim.path, "--data", data.path, "--out"]
    of_all = ["--data-table", ALL] if data.table == ALL else []
    report = out.with_name(f"{out.name}-report")
    log.info(f"next: {shlex.join(map(str, [*words, report, *of_all]))}")


def _workplace(
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


def _job(
    pair: Pair,
    folder: Path | str,
    recipe: Recipe,
    peak: str,
    init: Run | None,
    seed: int,
    device: str,
    resume: bool,
) -> TrainingJob:
    """Read and prepare both sides, and warn of what makes a training on them doubtful."""
    selection = parse_selection(peak, recipe.peaks)
    sim = load_pulses(pair[0], "simulated", recipe, selection)
    data = load_pulses(pair[1], "measured", recipe, selection)
    require_same_sampling(sim, data)
    require_both_sides(sim, data, selection)
    for finding in compare_sides(sim, data, selection):
        if finding.level != Level.FINE:
            log.warning(finding)
    away, beside = continuum(recipe), None
    enough = min(int(away.select(side.energies_kev).sum()) for side in (sim, data)) >= MIN_N
    if enough and not selection.ranges_kev:
        beside = partial(_continuum, pair, recipe, away)
    if init is not None and not np.isclose(init.dt_ns, data.dt_ns):
        kinds = f"trained on {init.dt_ns:g} ns, these pulses have {data.dt_ns:g} ns"
        raise CpunetError(f"{init.name}: {kinds}; resample them")
    return TrainingJob(
        recipe, peak, seed, device, sim, data, pair[1], Path(folder), init, resume, beside
    )


def _continuum(pair: Pair, recipe: Recipe, away: EnergySelection) -> tuple[Pulses, Pulses]:
    """Pulses of both sides away from all lines, read when a fit needs them."""
    sim = load_pulses(pair[0], "simulated", recipe, away, tell=False)
    data = load_pulses(pair[1], "measured", recipe, away, tell=False)
    return sim.prepared.pulses, data.prepared.pulses


def _trained(job: TrainingJob, out: Path | None) -> Run:
    """Train, and write the folder of the job, which becomes `out`."""
    keep_freed_memory()
    with one_thread_for_matrices():
        run = FITS[job.recipe.training.method](job)
    run.write(job.folder)
    run = run.model_copy(update={"folder": out})
    vars(run)["records"] = read_losses(job.folder)  # the folder moves, or goes
    return run
