"""A training: its recipe and its pulses, the fit of a readout chain, and where it writes."""

from __future__ import annotations

import logging
import resource
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np

from cpunet.electronics.measured import trace_noise
from cpunet.errors import CpunetError
from cpunet.kernels import threads
from cpunet.networks import require_torch
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.outputs import folder_written_aside
from cpunet.processes import keep_freed_memory, one_thread_for_matrices
from cpunet.progress import stage
from cpunet.pulses.channels import Pair, own_folder
from cpunet.pulses.loading import (
    InputSet,
    load_pulses,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.recipes.schema import PunetConfig, Recipe
from cpunet.training.chain_fit import Fitter, Listener
from cpunet.training.chain_parameters import with_settings
from cpunet.training.check import Level, compare_sides
from cpunet.training.diagnosis import DRIFT, beyond
from cpunet.training.inverse import fit_inverse
from cpunet.training.pulse_sets import MIN_PULSES, Continuum, PulseSets, continuum
from cpunet.training.response_fit import fit_response
from cpunet.training.run import (
    INFO,
    RUN,
    Record,
    Run,
    RunLike,
    append_losses,
    as_run,
    read_losses,
    versions,
)
from cpunet.training.verdict import FitInfo

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

    @classmethod
    def of(
        cls,
        pair: Pair,
        folder: Path,
        *,
        recipe: Recipe,
        peak: str,
        init: Run | None,
        **how: Any,
    ) -> Self:
        """Read and prepare both sides, and warn of what makes a training on them doubtful."""
        selection = parse_selection(peak, recipe.peaks)

        data = load_pulses(pair[1], "measured", recipe, selection, shorten=True)
        recipe = data.recipe

        def simulated(energies: EnergySelection, tell: bool = True) -> InputSet:
            return load_pulses(pair[0], "simulated", recipe, energies, tell=tell)

        def both(energies: EnergySelection) -> tuple[InputSet, InputSet]:
            measured = load_pulses(pair[1], "measured", recipe, energies, tell=False)
            return simulated(energies, tell=False), measured

        sim = simulated(selection)
        require_same_sampling(sim, data)
        require_both_sides(sim, data, selection)
        for finding in compare_sides(sim, data, selection, recipe.preparation):
            if finding.level != Level.FINE:
                log.warning(finding)
        if init is not None and not np.isclose(init.dt_ns, data.dt_ns):
            kinds = f"trained on {init.dt_ns:g} ns, these pulses have {data.dt_ns:g} ns"
            raise CpunetError(f"{init.name}: {kinds}; resample them")
        away = continuum(recipe)
        fewest = min(int(away.select(side.energies_kev).sum()) for side in (sim, data))
        more = None
        if fewest >= MIN_PULSES and not selection.ranges_kev:
            more = partial(both, away)
        how |= {"sim": sim, "data": data, "init": init, "continuum": more}
        return cls(recipe.at(data.dt_ns), peak, folder=folder, **how)

    def trained(self, out: Path | None) -> Run:
        """Train, and write the folder of the job, which becomes `out`."""
        keep_freed_memory()
        train: Callable[[TrainingJob], Run] = train_chain
        if self.recipe.training.method == "cyclegan":
            from cpunet.training.network_runs import train_networks  # torch takes seconds

            train = train_networks
        with one_thread_for_matrices():
            run = train(self)
        run.write(self.folder)
        run = run.model_copy(update={"folder": out})
        vars(run)["records"] = read_losses(self.folder)  # the folder moves, or goes
        return run

    def run(
        self,
        parts: Mapping[str, Any],
        recipe: Recipe,
        started: str,
        seconds: float,
        **more: Any,
    ) -> Run:
        """The run of trained networks.

        Parameters
        ----------
        parts
            ``ren``, ``iren`` and others to store.
        recipe
            Recipe as trained; a stretch or deviations may have been added to its chain.
        started, seconds
            When the training began, and the time that it took.
        more
            Further facts of the run.
        """
        unit = 2**20 if sys.platform == "darwin" else 2**10
        memory = {"host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit}
        if self.device.startswith("cuda"):
            import torch

            memory["gpu"] = torch.cuda.max_memory_allocated(self.device) / 2**20
        return Run.of(
            parts,
            recipe,
            peak=self.peak,
            seed=self.seed,
            init=None if self.init is None else self.init.name,
            device=self.device,
            threads=threads(),
            started=started,
            seconds=round(seconds, 1),
            peak_memory_mb={where: round(mb, 1) for where, mb in memory.items()},
            dt_ns=self.data.dt_ns,
            versions=versions(),
            sim=self.sim.provenance(),
            data=self.data.provenance(),
            **more,
        )


def of_channel(
    name: str, pair: Pair, folder: Path, *, init: RunLike | None, force: bool, **how: Any
) -> Path:
    """The folder of the run of a channel, trained in a process of its own."""
    if how["resume"] and (folder / INFO).is_file():
        log.info(f"{name}: trained already")
        return folder
    if isinstance(init, str | Path):
        init = own_folder(Path(init), name, INFO)
    trained_in(folder, pair, init, force, **how)
    return folder


def trained_in(
    out: Path | None, pair: Pair, init: RunLike | None, force: bool, **how: Any
) -> Run:
    """Read both sides, train and write a run; `how` is what `TrainingJob.of` takes."""
    start = None if init is None else as_run(init)
    files = (*pair[0].files, *pair[1].files, None if start is None else start.folder)
    place: AbstractContextManager[Path | str]
    if out is None:
        place = TemporaryDirectory()
    elif how["recipe"].networks:
        require_torch()
        from cpunet.training.unfinished import unfinished_folder

        place = unfinished_folder(out, *files, resume=how["resume"], force=force)
    else:
        place = folder_written_aside(out, RUN, *files, force=force)
    with place as folder:
        return TrainingJob.of(pair, Path(folder), init=start, **how).trained(out)


def known_response(run: Run, like: Recipe) -> ElectronicsResponse:
    """The response of a run, as a starting point for a recipe.

    Raises
    ------
    CpunetError
        If the run has no response of the recipe's kind.
    """
    generator = run.recipe.generator
    if generator.name != like.generator.name or isinstance(generator, PunetConfig):
        raise CpunetError(
            f"{run.name}: of recipe {run.recipe.name}, from which {like.name} cannot start; "
            f"give a run of {like.name}"
        )
    response: ElectronicsResponse = run.fill(
        "ren", ResponseGenerator(generator, run.dt_ns)
    ).response
    return response


def fitted(
    job: TrainingJob, start: ElectronicsResponse | None, listen: Listener
) -> tuple[ResponseGenerator, FitInfo]:
    """Measure the noise, fit the response, and say how well it describes the data.

    Parameters
    ----------
    job
        Pulses of both sides, and a recipe with a response to fit.
    start
        Response to start from, if any.
    listen
        Function called with step and chi-square.

    Raises
    ------
    CpunetError
        If pulses or baselines are too few, or the fit diverges.
    """
    recipe, (sim, data) = job.recipe, (job.sim.prepared, job.data.prepared)
    noise, tails = trace_noise(job.data, recipe.preparation)
    if start is not None:  # its deviations are those of another readout
        terms = min(start.config.drift_terms, recipe.matching.training.drift_terms)
        start = with_settings(start, drift_terms=terms, deviations=False, by_height=False)
        recipe = recipe.model_copy(update={"generator": start.config})
    rng, drawn = np.random.default_rng(job.seed), noise.tails
    sets = PulseSets(sim.pulses, data.pulses, noise.noise, recipe, rng, drawn, job.continuum)
    decay = None if drawn is None else drawn.known_decay
    response, info = fit_response(sets, Fitter(recipe.matching.training, decay, listen), start)
    chain = ResponseGenerator(response.config, job.sim.dt_ns)
    chain.response, chain.tails = response, drawn
    chain.set_noise(noise.noise)
    of_noise = {
        "baselines": noise.noise.n_baselines,
        "rms": noise.noise.rms,
        "rms_error": noise.noise.rms_error,
    }
    return chain, info.model_copy(update={"noise": of_noise, "tails": tails})


def _say(info: FitInfo) -> None:
    """Log which pulses were compared, how well the fit describes them, and why not."""
    compared = ", ".join(f"{name} {n}/{m}" for name, (n, m) in info.bands.items())
    log.info(f"compared (simulated/measured pulses): {compared}")
    if any(info.in_no_band.values()):
        log.info(
            "in no band, since a side has too few of their energies: "
            f"{info.in_no_band['sim']} simulated and {info.in_no_band['data']} measured pulses"
        )
    fine = info.checks is not None and info.checks.good
    fine &= "drift_stretch" not in info.parameters  # whose cause the verdict names
    log.log(logging.INFO if fine else logging.WARNING, f"the fit is {info.verdict}")
    for part, gain in info.gains.items():
        if part != DRIFT[1] or "drift_stretch" not in info.parameters:  # else in the verdict
            log.info(f"{part}: {gain}")
    for number, cause in enumerate(info.causes, 1):
        log.info(f"  {number}. {cause}")
    for doubt in beyond(info.parameters):
        log.warning(doubt)


def train_chain(job: TrainingJob, start: ElectronicsResponse | None = None) -> Run:
    """Fit a readout chain, starting from that of ``init`` or from `start`, if given."""
    started, clock = datetime.now(UTC), time.perf_counter()
    if job.init is not None:
        start = known_response(job.init, job.recipe)
    with stage("Fitting") as bar:  # the number of steps is not foreseen

        def listen(step: int, chi_square: float) -> None:
            losses = {"chi_square": chi_square}
            record: Record = {"iteration": step, "rate": 0.0, "losses": losses}
            if job.recipe.residual is None:  # else the log is that of the networks
                append_losses(job.folder, [record])
            bar.update(1)
            bar.set_postfix_str(f"chi-square {chi_square:.4g}", refresh=False)

        chain, info = fitted(job, start, listen)
    _say(info)
    # a stretch or deviations may have been added
    recipe = job.recipe.model_copy(update={"generator": chain.response.config})
    sim = job.sim.prepared.pulses
    iren = fit_inverse(chain, sim.waveforms, sim.energy_kev, recipe, seed=job.seed)
    parts: dict[str, Any] = {"ren": chain, "iren": iren}
    if recipe.residual is not None:
        from cpunet.training.network_runs import learned_residuals

        learned = learned_residuals(job, recipe, chain, iren)
        info = info.model_copy(update={"gains": info.gains | learned.gains})
        for part, gain in learned.gains.items():
            log.info(f"{part}: {gain}")
        if learned.parts:
            parts |= learned.parts
        else:  # the readout alone
            recipe = recipe.model_copy(update={"residual": None})
    took, began = time.perf_counter() - clock, started.isoformat(timespec="seconds")
    return job.run(parts, recipe, began, took, fit=info)
