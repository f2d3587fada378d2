"""Describe fitted readout chains by physical quantities, and compare them with the truth."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import cpunet
from cpunet.electronics.chain import Electronics
from cpunet.errors import CpunetError
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.outputs import FolderKind, folder_written_aside, refuse_existing
from cpunet.recipes.network_settings import ResponseConfig
from cpunet.recipes.schema import PreparationConfig
from cpunet.settings import checked, read_json
from cpunet.training.closed_forms import (
    learned_chain,
    slow_numbers,
    true_chain_of,
    true_parameters,
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
    response_figure,
)
from cpunet.training.run import FitInfo, Run, RunLike, as_run

MARKER = "response.json"
RESPONSE = FolderKind(
    name="response",
    command="cpunet response",
    known_by=MARKER,
    own=r"response\.json|response\.png",
)

_DPI = 150
_LONG_DRIFT_NS = 1000.0  # maximum lead of a slowly drifting charge over one collected at once


@dataclass(frozen=True, eq=False)
class _Response:
    """The chain of a run, and its parameters with their errors."""

    run: Run
    chain: Chain
    parameters: Numbers
    errors: Numbers


def describe_responses(
    given: Sequence[RunLike],
    *,
    truth: Electronics | None = None,
    out: Path | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Describe the fitted readout chains of trainings by physical quantities.

    Parameters
    ----------
    given
        Trainings of a readout chain, all with the same sampling and preparation.
    truth
        True chain of the data, if known (`stand_electronics`).
    out
        Folder to create, with ``response.json`` and ``response.png``; None for none.
    force
        Whether to replace an existing folder.

    Returns
    -------
    dict
        Content of ``response.json``.  ``runs``: for each run its ``values`` by name, with the
        unit as suffix (shares of the full charge have none), ``errors`` of the fitted
        quantities and of the noise, all ``parameters`` with their ``parameter_errors``, and
        ``doubts``, reasons why these do not describe a readout alone.
        ``mean`` and ``spread`` (standard deviation) of several runs.  ``truth``: the same
        ``values`` of the true chain, the ``difference`` of the run or of the mean of the runs
        from it, and ``sigma``, the difference divided by the error or the spread, whichever
        is larger.  A quantity without an error has no sigma: the runs share their data, so
        their spread shows how well they agree, not how accurate they are.

    Raises
    ------
    CpunetError
        If a run has no readout chain, or runs or truth are incompatible.
    """
    runs = [as_run(run) for run in given]
    folders = [run.folder for run in runs]
    if out is not None:
        refuse_existing(out, *folders, force=force)
    learned = [_response(run) for run in runs]
    if not learned:
        raise CpunetError("no run was given; give the folder of one")
    first, preparation = runs[0], runs[0].recipe.preparation
    require_alike([(run.name, run.dt_ns, run.recipe.preparation) for run in runs])
    _require_sampling(first, truth)
    told: dict[str, Any] = {
        "cpunet": cpunet.__version__,
        "dt_ns": first.dt_ns,
        "runs": [_told(one) for one in learned],
    }
    true_chain = None if truth is None else true_chain_of(truth)
    told |= _summary(told["runs"])
    if truth is not None and true_chain is not None:
        values = true_parameters(truth) | chain_numbers(true_chain, preparation, first.dt_ns)
        told["truth"] = {"name": truth.name} | _compared(told, values)
    if out is not None:
        window = preparation.samples_after * first.dt_ns
        figure = response_figure([r.chain for r in learned], true_chain, tail_ns=window)
        with folder_written_aside(out, RESPONSE, *folders, force=force) as folder:
            text = json.dumps(told, indent=1, ensure_ascii=False)
            (folder / MARKER).write_text(text + "\n", encoding="utf-8")
            figure.savefig(folder / "response.png", dpi=_DPI)
    return told


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
    told = _told(_response(run))
    if "noise_rms_kev" not in told["values"]:
        raise CpunetError(f"{run.name}: holds no noise; train on raw traces")
    return told["values"]["noise_rms_kev"], told["errors"].get("noise_rms_kev")


def stand_electronics(stand: Path) -> Electronics:
    """The true electronics of a virtual test stand, from its ``stand.json``.

    Raises
    ------
    CpunetError
        If the folder is not a virtual test stand.
    """
    path = Path(stand) / "stand.json"
    content = read_json(path, "give the folder of a test stand, as of `cpunet stand`")
    return checked(Electronics, content.get("electronics"), f"{path}: electronics")


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
    doubts = beyond(found.parameters) + stretched(found.parameters)
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


def _summary(runs: Sequence[Mapping[str, Any]]) -> dict[str, Numbers]:
    """Mean and spread of several runs."""
    if len(runs) < 2:
        return {}
    names = [name for name in runs[0]["values"] if all(name in r["values"] for r in runs)]
    columns = {name: [run["values"][name] for run in runs] for name in names}
    return {
        "mean": {name: float(np.mean(column)) for name, column in columns.items()},
        "spread": {name: float(np.std(column, ddof=1)) for name, column in columns.items()},
    }


def _compared(told: Mapping[str, Any], values: Numbers) -> dict[str, Numbers]:
    """Truth, and the difference of the run or of the mean of the runs from it."""
    runs = told["runs"]
    found: Numbers = told.get("mean", runs[0]["values"])
    spread: Numbers = told.get("spread", {})
    difference = {n: found[n] - true for n, true in values.items() if n in found}
    sigma = {}
    for name, apart in difference.items():
        errors = [run["errors"][name] for run in runs if name in run["errors"]]
        if len(errors) == len(runs) and any(errors):
            sigma[name] = apart / max(spread.get(name, 0.0), float(np.mean(errors)))
    return {"values": values, "difference": difference, "sigma": sigma}


def require_alike(runs: Sequence[tuple[str, float, PreparationConfig]]) -> None:
    """Raise a `CpunetError` unless all runs have the first's period (ns) and preparation."""
    (first, first_ns, preparation), *others = runs
    for run, dt_ns, other in others:
        if not np.isclose(dt_ns, first_ns):
            raise CpunetError(
                f"{run}: trained on pulses sampled every {dt_ns:g} ns, {first} every "
                f"{first_ns:g} ns; describe them one by one"
            )
        if other != preparation:
            raise CpunetError(
                f"{run}: trained with another preparation than {first}; describe them one by "
                "one"
            )


def _require_sampling(first: Run, truth: Electronics | None) -> None:
    if truth is not None and not np.isclose(truth.dt_ns, first.dt_ns):
        raise CpunetError(
            f"{first.name}: trained on pulses sampled every {first.dt_ns:g} ns, electronics "
            f"{truth.name} samples every {truth.dt_ns:g} ns; give the truth of its data"
        )
