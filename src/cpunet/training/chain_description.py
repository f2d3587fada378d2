"""A fitted readout chain by physical quantities."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.network_settings import ResponseConfig
from cpunet.recipes.schema import PreparationConfig
from cpunet.training.closed_forms import (
    learned_chain,
    slow_numbers,
    with_noise,
)
from cpunet.training.diagnosis import beyond, stretched
from cpunet.training.response_errors import fitted_errors, propagated
from cpunet.training.response_figure import (
    Chain,
    Numbers,
    align_ns,
    chain_numbers,
    noise_numbers,
)
from cpunet.training.run import FitInfo, Run

_LONG_DRIFT_NS = 1000.0  # maximum lead of a slowly drifting charge over one collected at once


@dataclass(frozen=True, eq=False)
class _Response:
    """The chain of a run, and its parameters with their errors."""

    run: Run
    chain: Chain
    parameters: Numbers
    errors: Numbers


def describe_chain(run: Run) -> dict[str, Any]:
    """A readout chain in numbers.

    Returns
    -------
    dict
        ``values`` by name, with the unit as suffix (shares of the full charge have none),
        ``errors`` of the fitted quantities and of the noise, all ``parameters`` with their
        ``parameter_errors``, and ``doubts``, reasons why these do not describe a readout
        alone.

    Raises
    ------
    CpunetError
        If the run has no response in closed form.
    """
    return _told(_response(run))


def chain_of(run: Run) -> Chain:
    """The readout chain fitted by a training, with its noise.

    Raises
    ------
    CpunetError
        If the run has no response in closed form.
    """
    return _response(run).chain


def noise_kev(run: Run) -> tuple[float, float | None]:
    """RMS of the noise that a training measured, and its error if known, in keV.

    Raises
    ------
    CpunetError
        If the run has no response in closed form, or no noise.
    """
    told = describe_chain(run)
    if "noise_rms_kev" not in told["values"]:
        raise CpunetError(f"{run.name}: holds no noise; train on raw traces")
    return told["values"]["noise_rms_kev"], told["errors"].get("noise_rms_kev")


def _response(run: Run) -> _Response:
    recipe = run.recipe
    if not isinstance(recipe.generator, ResponseConfig):
        raise CpunetError(
            f"{run.name}: recipe {recipe.name} trains a {recipe.generator.name}, which has no "
            "response in closed form; give a run of the recipe fast, or score this one with "
            "`cpunet validate`"
        )
    network = run.fill("ren", ResponseGenerator(recipe.generator, run.dt_ns))
    try:
        found = _described(run, network)
    except (ArithmeticError, ValueError, LookupError, RuntimeError) as error:
        raise CpunetError(
            f"{run.name}: its weights make no response of electronics ({error}); train again"
        ) from error
    wrong = [name for name, value in found.parameters.items() if not math.isfinite(value)]
    if wrong:
        raise CpunetError(f"{run.name}: {wrong[0]} of its response is no number; train again")
    return found


def _described(run: Run, network: ResponseGenerator) -> _Response:
    response, preparation, fit = network.response, run.recipe.preparation, run.fit or FitInfo()
    chain = learned_chain(response, Path(run.name).name)
    if int(network.n_baselines):
        chain = with_noise(chain, network, preparation)
    parameters = response.describe()
    if len(response.ringing):
        parameters["ringing"] = response.ringing.norm().item()
    errors = fitted_errors(response, fit.errors)
    errors |= propagated(
        response,
        fit.covariance,
        lambda moved: _shape_numbers(moved, preparation, run.dt_ns),
    )
    return _Response(run, chain, parameters, errors)


def _shape_numbers(
    response: ElectronicsResponse, preparation: PreparationConfig, dt_ns: float
) -> Numbers:
    """Derived numbers of a response, which are not parameters of the fit."""
    slow = list(zip(response.slow_ns.tolist(), response.slow_weights.tolist(), strict=True))
    numbers = chain_numbers(learned_chain(response, ""), preparation, dt_ns)
    return slow_numbers(slow) | numbers


def _told(found: _Response) -> dict[str, Any]:
    run, parameters = found.run, found.parameters
    slow = {n: w for n, w in parameters.items() if n.startswith("slow_")}
    values = {n: v for n, v in parameters.items() if n not in slow}
    values |= slow_numbers([(float(n.split("_")[1]), w) for n, w in slow.items()])
    values |= chain_numbers(found.chain, run.recipe.preparation, run.dt_ns)
    if run.fit is not None and run.fit.chi_square_per_moment is not None:
        values["chi_square_per_moment"] = run.fit.chi_square_per_moment
    return {
        "path": run.name,
        "recipe": run.recipe.name,
        "peak": run.peak,
        "seed": run.seed,
        "values": values,
        "errors": {n: e for n, e in found.errors.items() if n in values} | _noise_error(found),
        "parameters": parameters,
        "parameter_errors": found.errors,
        "doubts": _doubts(found),
    }


def _doubts(found: _Response) -> list[str]:
    """Reasons why the numbers of a run do not describe a readout alone."""
    fit = found.run.fit
    gains = {} if fit is None else fit.gains
    doubts = beyond(found.parameters) + stretched(found.parameters, gains)
    if fit is not None and fit.causes:
        doubts.insert(
            0,
            f"poor fit: {fit.verdict}; these numbers stand in for what is wrong "
            f"with the simulation, too: {fit.causes[0]}",
        )
    return doubts


def _noise_error(found: _Response) -> Numbers:
    """Error of the noise in keV, from the baselines and the height of a full charge."""
    run, chain = found.run, found.chain
    measured = {} if run.fit is None else run.fit.noise
    error, rms = measured.get("rms_error"), measured.get("rms")
    if not error or not rms or chain.noise_kev2_per_mhz is None:
        return {}
    preparation = run.recipe.preparation
    end_ns = align_ns(chain, preparation) + preparation.samples_after * run.dt_ns
    sooner, at_once = (float(chain.whole.step(end_ns + t)) for t in (_LONG_DRIFT_NS, 0.0))
    kev = noise_numbers(chain)["noise_rms_kev"]
    return {"noise_rms_kev": kev * float(np.hypot(error / rms, sooner / at_once - 1))}
