"""Fit a response, its noise and its inverse to prepared pulses of both sides."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from torch import nn

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.measured import find_tails, measured_noise
from cpunet.errors import CpunetError
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse, Readout
from cpunet.progress import stage
from cpunet.pulses.loading import InputSet
from cpunet.recipes.network_settings import LearnedConfig, PunetConfig
from cpunet.recipes.schema import Recipe
from cpunet.training.diagnosis import beyond, diagnosis, stretched
from cpunet.training.inverse import fit_inverse
from cpunet.training.learned_fit import fit_learned
from cpunet.training.levenberg_marquardt import Listener
from cpunet.training.loop import Record
from cpunet.training.pulse_sets import SINGLE, Continuum
from cpunet.training.response_fit import Fit, fit_response
from cpunet.training.response_starts import DRIFT, with_drift_terms
from cpunet.training.run import FitInfo, Run, append_losses

if TYPE_CHECKING:
    from cpunet.training.job import TrainingJob

log = logging.getLogger(__name__)


def known_response(run: Run, like: Recipe) -> Readout:
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
    known: Readout = run.fill("ren", ResponseGenerator(generator, run.dt_ns)).response
    return known


class Matched(NamedTuple):
    """A fitted chain.

    Parameters
    ----------
    model
        Module with ``ren`` and ``iren``.
    info
        What a run keeps of the fit.
    recipe
        Recipe of the response as fitted: a ringing or a stretch may have been added.
    fit
        Result of the fit.
    remark
        Remark on the noise, if any.
    """

    model: nn.Module
    info: FitInfo
    recipe: Recipe
    fit: Fit
    remark: str | None

    def log(self) -> None:
        """Tell which pulses were compared, how well the fit describes them, and why not."""
        fit, info = self.fit, self.info
        if self.remark is not None:
            log.warning(self.remark)
        compared = ", ".join(f"{name} {n}/{m}" for name, (n, m) in fit.bands.items())
        log.info(f"compared (simulated/measured pulses): {compared}")
        beside = info.in_no_band
        if any(beside.values()):
            log.info(
                f"in no band, since one side has too few of their energies: {beside['sim']} "
                f"simulated and {beside['data']} measured pulses"
            )
        if fit.poor:
            log.warning(f"poor fit: {fit.verdict}")
        else:
            log.info(f"fit: {fit.verdict}")
        if fit.drift is not None:
            log.info(str(fit.drift))
        for part, gain in fit.gains.items():
            if part != DRIFT[1] or "drift_stretch" not in info.parameters:
                log.info(f"{part}: {gain}")
        for number, cause in enumerate(info.causes, 1):
            log.info(f"  {number}. {cause}")
        for found in beyond(info.parameters) + stretched(info.parameters, fit.gains):
            log.warning(found)


def match(
    sim: InputSet,
    data: InputSet,
    recipe: Recipe,
    seed: int,
    listen: Listener,
    known: Readout | None = None,
    continuum: Continuum | None = None,
) -> Matched:
    """Measure the noise, fit the response, and invert it.

    Parameters
    ----------
    sim, data
        Pulses of both sides.
    recipe
        Recipe with a response to fit.
    seed
        Seed of all random numbers.
    listen
        Function called with step and chi-square.
    known
        Response to start from, if any.
    continuum
        Reads the pulses of both sides away from all lines, if a fit needs them.

    Raises
    ------
    CpunetError
        If there are too few pulses or baselines, or the fit diverges.
    """
    tails, drawn, tails_info = find_tails(data, recipe.preparation)
    noise, remark = measured_noise(data, recipe.preparation, tails)
    if isinstance(known, ElectronicsResponse):
        allowed = recipe.matching.training.drift_terms
        if known.config.drift_terms > allowed:
            known = with_drift_terms(known, allowed)
        recipe = recipe.model_copy(update={"generator": known.config})
    given: dict[str, Any] = {
        "seed": seed,
        "known": known,
        "tails": drawn,
        "listener": listen,
    }
    fitted = fit_learned if isinstance(recipe.generator, LearnedConfig) else fit_response
    if fitted is fit_response:
        given["continuum"] = continuum
    simulated, measured = sim.prepared.pulses, data.prepared.pulses
    response, fit = fitted(simulated, measured, noise, recipe, **given)
    told = _described(fit, response, noise, len(sim.prepared), len(data.prepared))
    told["tails"] = tails_info
    recipe = recipe.model_copy(update={"generator": response.config})
    chain = ResponseGenerator(response.config, sim.dt_ns)
    chain.response = response
    chain.set_noise(noise)
    chain.tails = drawn
    iren = fit_inverse(chain, simulated.waveforms, simulated.energy_kev, recipe, seed=seed)
    model = nn.ModuleDict({"ren": chain, "iren": iren})
    return Matched(model, FitInfo.model_validate(told), recipe, fit, remark)


def _described(
    fit: Fit, response: Readout, noise: BaselineNoise, n_sim: int, n_data: int
) -> dict[str, Any]:
    """Content of `FitInfo`, without tails."""
    parameters = response.describe()
    counts = [pair for name, pair in fit.bands.items() if name != SINGLE]
    return {
        "parameters": parameters,
        **asdict(fit),
        "drift": fit.drift and {"verdict": str(fit.drift), **asdict(fit.drift)},
        "verdict": "; ".join([fit.verdict, *stretched(parameters, fit.gains)]),
        "causes": diagnosis(fit.pulls) if fit.poor else [],
        "in_no_band": {
            "sim": n_sim - sum(n for n, _ in counts),
            "data": n_data - sum(m for _, m in counts) - fit.data_left_out,
        },
        "noise": {
            "baselines": noise.n_baselines,
            "rms": noise.rms,
            "rms_error": noise.rms_error,
        },
    }


def train_chain(job: TrainingJob, known: Readout | None = None) -> Run:
    """Fit a readout chain, starting from that of ``init`` or from `known`, if given."""
    started, clock = datetime.now(UTC), time.perf_counter()
    if job.init is not None:
        known = known_response(job.init, job.recipe)
    with stage("Matching") as bar:  # how many steps a fit needs is not known

        def listen(step: int, chi_square: float) -> None:
            losses = {"chi_square": chi_square}
            record: Record = {"iteration": step, "rate": 0.0, "losses": losses}
            append_losses(job.folder, [record])
            bar.update(1)
            bar.set_postfix_str(f"chi-square {chi_square:.4g}", refresh=False)

        found = match(job.sim, job.data, job.recipe, job.seed, listen, known, job.continuum)
    found.log()
    seconds = time.perf_counter() - clock
    began = started.isoformat(timespec="seconds")
    return job.run(found.model, found.recipe, began, seconds, fit=found.info)
