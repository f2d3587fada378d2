"""A training: its recipe and its pulses, the fit of a readout chain, and where it writes."""

from __future__ import annotations

import logging
import time
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from cpunet.electronics.measured import trace_noise
from cpunet.networks import require_torch
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.outputs import folder_written_aside
from cpunet.processes import keep_freed_memory, one_thread_for_matrices
from cpunet.progress import stage
from cpunet.pulses.channels import Pair
from cpunet.pulses.loading import (
    InputSet,
    load_pulses,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.training.chain_fit import Fitter
from cpunet.training.check import Level, compare_sides
from cpunet.training.energy_bands import MIN_PULSES, continuum
from cpunet.training.inverse import fit_inverse
from cpunet.training.pulse_sets import Continuum, PulseSets
from cpunet.training.response_fit import fit_response
from cpunet.training.run import INFO, RUN, Record, Run, versions
from cpunet.training.verdict import DRIFT, FitInfo, beyond

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
    checkpoints, resume
        Folder of the checkpoints of networks, and whether their training is to be resumed.
    continuum
        Reads the pulses of both sides away from all lines.
    """

    recipe: Recipe
    peak: str
    seed: int
    device: str
    sim: InputSet
    data: InputSet
    checkpoints: Path | None = None
    resume: bool = False
    continuum: Continuum | None = None

    @classmethod
    def of(cls, pair: Pair, recipe: Recipe, peak: str, **how: Any) -> Self:
        """Read and prepare both sides, and warn of what makes a training on them doubtful."""
        selection = parse_selection(peak, recipe.peaks)
        data = load_pulses(pair[1], "measured", recipe, selection, shorten=True)
        recipe = data.recipe
        sim = load_pulses(pair[0], "simulated", recipe, selection)
        require_same_sampling(sim, data)
        require_both_sides(sim, data, selection)
        for finding in compare_sides(sim, data, selection, recipe.preparation):
            if finding.level != Level.FINE:
                log.warning(finding)

        def both() -> tuple[InputSet, InputSet]:
            measured = load_pulses(pair[1], "measured", recipe, away, tell=False)
            return load_pulses(pair[0], "simulated", recipe, away, tell=False), measured

        away = continuum(recipe)
        fewest = min(int(away.select(side.energies_kev).sum()) for side in (sim, data))
        if fewest >= MIN_PULSES and not selection.ranges_kev:
            how["continuum"] = both
        return cls(recipe.at(data.dt_ns), peak, sim=sim, data=data, **how)

    def trained(self) -> Run:
        """Train what the recipe says."""
        keep_freed_memory()
        with one_thread_for_matrices():
            if self.recipe.training.method == "matching":
                return train_chain(self)
            from cpunet.training.network_runs import train_networks  # torch takes seconds

            return train_networks(self)

    def run(
        self, parts: dict[str, Any], recipe: Recipe, started: str, clock: float, **more: Any
    ) -> Run:
        """The run of trained parts.

        Parameters
        ----------
        parts
            ``ren``, ``iren`` and others to store.
        recipe
            Recipe as trained; a stretch or deviations may have been added to its chain.
        started, clock
            When the training began, and what `time.perf_counter` said then.
        more
            Further facts of the run, as its ``log``.
        """
        facts = {"peak": self.peak, "seed": self.seed, "device": self.device}
        facts |= {"started": started, "seconds": round(time.perf_counter() - clock, 1)}
        facts |= {"dt_ns": self.data.dt_ns, "versions": versions()}
        facts |= {"sim": self.sim.provenance(), "data": self.data.provenance()}
        return Run.of(parts, recipe, **facts, **more)


def trained_in(name: str, pair: Pair, out: Path | None, *, force: bool, **how: Any) -> Run:
    """Read both sides, train and write a run; `how` is what `TrainingJob.of` takes.

    Of several channels, each has a name, and a run that is complete is resumed by loading it.
    """
    if name and out is not None and how["resume"] and (out / INFO).is_file():
        log.info(f"{name}: trained already")
        return Run.load(out)
    files = *pair[0].files, *pair[1].files
    networks, folder = how["recipe"].networks, None
    if networks:
        require_torch()
    with ExitStack() as stack:
        if out is not None and networks:
            from cpunet.training.unfinished import unfinished_folder

            unfinished = unfinished_folder(out, *files, resume=how["resume"], force=force)
            how["checkpoints"] = stack.enter_context(unfinished)
        elif out is not None:
            folder = stack.enter_context(folder_written_aside(out, RUN, *files, force=force))
        run = TrainingJob.of(pair, **how).trained()
        if out is not None:
            folder = folder or stack.enter_context(folder_written_aside(out, RUN, force=force))
            run.write(folder)
    return run.model_copy(update={"folder": out})


def train_chain(job: TrainingJob, start: ElectronicsResponse | None = None) -> Run:
    """Fit a readout chain, starting from `start`, if given.

    Raises
    ------
    CpunetError
        If pulses or baselines are too few, or the fit diverges.
    """
    started, clock = datetime.now(UTC).isoformat(timespec="seconds"), time.perf_counter()
    recipe, sim = job.recipe, job.sim.prepared.pulses
    records = list[Record]()
    with stage("Fitting") as bar:  # the number of steps is not foreseen

        def listen(step: int, chi_square: float) -> None:
            losses = {"chi_square": chi_square}
            records.append({"iteration": step, "rate": 0.0, "losses": losses})
            bar.update(1)
            bar.set_postfix_str(f"chi-square {chi_square:.4g}", refresh=False)

        noise, tails = trace_noise(job.data, recipe.preparation)
        pulses, rng = (sim, job.data.prepared.pulses), np.random.default_rng(job.seed)
        sets = PulseSets(*pulses, noise, recipe, rng, job.continuum)
        fitter = Fitter(recipe.matching.training, listen)
        response, info = fit_response(sets, fitter, start)
    chain = ResponseGenerator(response.config, job.sim.dt_ns)
    chain.response, chain.tails = response, noise.tails
    chain.set_noise(noise)
    n, rms, error = noise.n_baselines, noise.rms, noise.rms_error
    of_noise = {"baselines": n, "rms": rms, "rms_error": error}
    info = info.model_copy(update={"noise": of_noise, "tails": tails})
    _say(info)
    # a stretch or deviations may have been added
    recipe = job.recipe.model_copy(update={"generator": response.config})
    iren = fit_inverse(chain, sim.waveforms, sim.energy_kev, recipe, seed=job.seed)
    parts: dict[str, Any] = {"ren": chain, "iren": iren}
    if recipe.residual is not None:
        from cpunet.training.network_runs import learned_residuals

        residuals, gains, of_networks = learned_residuals(job, recipe, chain, iren)
        info = info.model_copy(update={"gains": info.gains | gains})
        records = of_networks or records
        for part, gain in gains.items():
            log.info(f"{part}: {gain}")
        parts |= residuals
        if not residuals:  # the readout alone
            recipe = recipe.model_copy(update={"residual": None})
    return job.run(parts, recipe, started, clock, log=records, fit=info)


def _say(info: FitInfo) -> None:
    """Log which pulses were compared, how well the fit describes them, and why not."""
    compared = ", ".join(f"{name} {n}/{m}" for name, (n, m) in info.bands.items())
    log.info(f"compared (simulated/measured pulses): {compared}")
    if info.sim_left_out or info.data_left_out:
        both = f"{info.sim_left_out} simulated and {info.data_left_out} measured pulses"
        log.info(f"left out, as piled up or collected late: {both}")
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
