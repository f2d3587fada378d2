"""A training: its recipe and its pulses, the fit of a readout chain, and where it writes."""

from __future__ import annotations

import logging
import resource
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

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
from cpunet.training.diagnosis import beyond, stretched
from cpunet.training.inverse import fit_inverse
from cpunet.training.pulse_sets import MIN_PULSES, Continuum, PulseSets, continuum
from cpunet.training.response_fit import DRIFT, Fit, fit_response
from cpunet.training.run import (
    INFO,
    RUN,
    FitInfo,
    Record,
    Run,
    RunLike,
    append_losses,
    as_run,
    read_losses,
    versions,
)

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


@dataclass(frozen=True)
class Training:
    """How to train, whatever the pulses; see `cpunet.train`."""

    recipe: Recipe
    peak: str
    init: RunLike | None
    seed: int
    device: str
    resume: bool
    force: bool

    def of_channel(self, name: str, pair: Pair, folder: Path) -> Path:
        """The folder of the run of a channel, trained in a process of its own."""
        if self.resume and (folder / INFO).is_file():
            log.info(f"{name}: trained already")
            return folder
        init = self.init
        if isinstance(init, str | Path):
            init = own_folder(Path(init), name, INFO)
        start = None if init is None else as_run(init)
        self.run(pair, folder, start)
        return folder

    def run(self, pair: Pair, out: Path | None, start: Run | None) -> Run:
        """Read, train and write a run."""
        files = (*pair[0].files, *pair[1].files, None if start is None else start.folder)
        place: AbstractContextManager[Path | str]
        if out is None:
            place = TemporaryDirectory()
        elif self.recipe.networks:
            require_torch()
            from cpunet.training.unfinished import unfinished_folder

            place = unfinished_folder(out, *files, resume=self.resume, force=self.force)
        else:
            place = folder_written_aside(out, RUN, *files, force=self.force)
        with place as folder:
            return self._job(pair, Path(folder), start).trained(out)

    def _job(self, pair: Pair, folder: Path, init: Run | None) -> TrainingJob:
        """Read and prepare both sides, and warn of what makes a training on them doubtful."""
        recipe, selection = self.recipe, parse_selection(self.peak, self.recipe.peaks)

        def read(energies: EnergySelection, tell: bool = True) -> tuple[InputSet, InputSet]:
            sim = load_pulses(pair[0], "simulated", recipe, energies, tell=tell)
            return sim, load_pulses(pair[1], "measured", recipe, energies, tell=tell)

        sim, data = read(selection)
        require_same_sampling(sim, data)
        require_both_sides(sim, data, selection)
        for finding in compare_sides(sim, data, selection, recipe.preparation):
            if finding.level != Level.FINE:
                log.warning(finding)
        away = continuum(recipe)
        there = min(int(away.select(side.energies_kev).sum()) for side in (sim, data))
        enough = there >= MIN_PULSES and not selection.ranges_kev
        beside = partial(read, away, tell=False) if enough else None
        if init is not None and not np.isclose(init.dt_ns, data.dt_ns):
            kinds = f"trained on {init.dt_ns:g} ns, these pulses have {data.dt_ns:g} ns"
            raise CpunetError(f"{init.name}: {kinds}; resample them")
        return TrainingJob(
            recipe.at(data.dt_ns),
            self.peak,
            self.seed,
            self.device,
            sim,
            data,
            folder,
            init,
            self.resume,
            beside,
        )


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
    known: ElectronicsResponse = run.fill(
        "ren", ResponseGenerator(generator, run.dt_ns)
    ).response
    return known


def match(
    job: TrainingJob, known: ElectronicsResponse | None, listen: Listener
) -> tuple[ResponseGenerator, FitInfo]:
    """Measure the noise, fit the response, and tell how well it describes the data.

    Parameters
    ----------
    job
        Pulses of both sides, and a recipe with a response to fit.
    known
        Response to start from, if any.
    listen
        Function called with step and chi-square.

    Raises
    ------
    CpunetError
        If there are too few pulses or baselines, or the fit diverges.
    """
    recipe, (sim, data) = job.recipe, (job.sim.prepared, job.data.prepared)
    noise, tails = trace_noise(job.data, recipe.preparation)
    if known is not None:  # its deviations are those of another readout
        terms = min(known.config.drift_terms, recipe.matching.training.drift_terms)
        known = with_settings(known, drift_terms=terms, deviations=False, by_height=False)
        recipe = recipe.model_copy(update={"generator": known.config})
    rng, drawn = np.random.default_rng(job.seed), noise.tails
    sets = PulseSets(sim.pulses, data.pulses, noise.noise, recipe, rng, drawn, job.continuum)
    decay = None if drawn is None else drawn.known_decay
    fitter = Fitter(recipe.matching.training, decay, listen)
    response, fit = fit_response(sets, fitter, known)
    parameters = response.describe()
    stretches = stretched(parameters, fit.gains)
    told = asdict(fit) | {
        "checks": fit.checks,
        "parameters": parameters,
        "delay_ns": response.delay_ns(),
        "verdict": "; ".join([fit.verdict, *stretches]),
        "causes": fit.checks.causes,
        "in_no_band": {
            "sim": len(sim) - sum(len(band.sim) for band, _ in sets.parted),
            "data": len(data) - sum(len(band.data) for band, _ in sets.parted),
        },
        "noise": {
            "baselines": noise.noise.n_baselines,
            "rms": noise.noise.rms,
            "rms_error": noise.noise.rms_error,
        },
        "tails": tails,
    }
    chain = ResponseGenerator(response.config, job.sim.dt_ns)
    chain.response = response
    chain.set_noise(noise.noise)
    chain.tails = drawn
    info = FitInfo.model_validate(told)
    _tell(fit, info, [*beyond(parameters), *stretches])
    return chain, info


def _tell(fit: Fit, info: FitInfo, doubts: list[str]) -> None:
    """Tell which pulses were compared, how well the fit describes them, and why not."""
    compared = ", ".join(f"{name} {n}/{m}" for name, (n, m) in fit.bands.items())
    log.info(f"compared (simulated/measured pulses): {compared}")
    beside = info.in_no_band
    if any(beside.values()):
        log.info(
            f"in no band, since one side has too few of their energies: {beside['sim']} "
            f"simulated and {beside['data']} measured pulses"
        )
    if not fit.checks.good:
        log.warning(f"the fit is {fit.verdict}")
    else:
        log.info(f"the fit is {fit.verdict}")
    for part, gain in fit.gains.items():
        if part != DRIFT[1] or "drift_stretch" not in info.parameters:
            log.info(f"{part}: {gain}")
    for number, cause in enumerate(info.causes, 1):
        log.info(f"  {number}. {cause}")
    for doubt in doubts:
        log.warning(doubt)


def train_chain(job: TrainingJob, known: ElectronicsResponse | None = None) -> Run:
    """Fit a readout chain, starting from that of ``init`` or from `known`, if given."""
    started, clock = datetime.now(UTC), time.perf_counter()
    if job.init is not None:
        known = known_response(job.init, job.recipe)
    with stage("Fitting") as bar:  # how many steps a fit needs is not known

        def listen(step: int, chi_square: float) -> None:
            losses = {"chi_square": chi_square}
            record: Record = {"iteration": step, "rate": 0.0, "losses": losses}
            if job.recipe.residual is None:  # else the log is that of the networks
                append_losses(job.folder, [record])
            bar.update(1)
            bar.set_postfix_str(f"chi-square {chi_square:.4g}", refresh=False)

        chain, info = match(job, known, listen)
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
