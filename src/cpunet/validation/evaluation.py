"""Apply a run to simulated pulses and compare them with measured ones."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.matrices import one_thread_for_matrices
from cpunet.progress import stage
from cpunet.pulses.loading import (
    InputSet,
    load_pulses,
    require_same_sampling,
)
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import Recipe
from cpunet.training.devices import resolve_device
from cpunet.training.run import Run
from cpunet.translation.translator import IREN, REN
from cpunet.validation.energy_ranges import (
    ae_against_energy,
    range_survivals,
    validation_selection,
)
from cpunet.validation.linearity import linearity_residual
from cpunet.validation.methods import fit_baseline_methods, translate_all
from cpunet.validation.peak_details import PeakDetails, peak_details
from cpunet.validation.peak_sets import PeakSets, current_amplitudes, peak_sets
from cpunet.validation.scoring import ByMethod, score_peak, survivals
from cpunet.validation.truth import Responses
from cpunet.validation.verdicts import summaries, verdict_table

PAIRS = 200  # pairs of pulses in the test of linearity
MAX_PULSES = 50_000  # per side, for an error of the scores of about 0.3 percentage points


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Results of a validation, from which figures and report are made.

    Parameters
    ----------
    ren, iren
        Translators of the run.
    run
        The run.
    sim, data
        Prepared pulses of both sides.
    sets, values, details
        Pulses, parameters by method, and further comparisons, each by peak.  The latter two
        exist only for scored peaks.
    metrics
        Content of ``metrics.json``.
    """

    ren: REN
    iren: IREN
    run: Run
    sim: InputSet
    data: InputSet
    sets: list[PeakSets]
    values: Mapping[str, ByMethod]
    details: Mapping[str, PeakDetails]
    metrics: dict[str, Any]


@one_thread_for_matrices()
def evaluate(
    run: Run,
    sim: PulseFile,
    data: PulseFile,
    *,
    truth: Path | None = None,
    baselines: bool = True,
    max_pulses: int = MAX_PULSES,
    seed: int = 0,
    device: str = "auto",
) -> Evaluation:
    """Translate, compare and score; see `cpunet.validation.validate.validate`.

    Raises
    ------
    CpunetError
        If the input cannot be used, or no peak can be scored.
    """
    device, recipe, trained_on = resolve_device(device), run.recipe, run.peak
    ren, iren = REN.of(run, device), IREN.of(run, device)
    names = list(dict.fromkeys([*recipe.peaks, trained_on]))
    sim_set, data_set = _load_both(ren, sim, data, names, max_pulses)
    responses = None if truth is None else Responses(truth, sim_set)
    others = fit_baseline_methods(
        sim_set,
        data_set,
        parse_selection(trained_on, recipe.peaks),
        recipe,
        tails=ren.tails,
        fitted=baselines,
    )
    made = translate_all(ren, others, sim_set, responses, seed)
    amplitudes = current_amplitudes(sim_set, data_set, made)
    sets = [peak_sets(name, recipe, sim_set, data_set, made, amplitudes) for name in names]
    values, peaks = _scores(sets, recipe, seed)
    scored = [peak for peak in sets if values[peak.name]]
    if not scored:
        raise CpunetError(
            f"{data_set.path}: no peak has pulses on both sides",
            "check the calibration (`kev_per_adc`, `data_energy`)",
        )
    details = _details(scored, values, recipe, seed)
    kept = survivals(values, seed)
    known = None if run.fit is None else run.fit.tails
    metrics = {
        "compared": _compared(run, sim_set, data_set),
        "peaks": peaks,
        "ae_survival": kept,
        "ae_details": {
            "survival by energy range": range_survivals(
                sim_set, data_set, amplitudes, kept, recipe
            ),
            "A/E and drift time together": {
                name: of_peak.plane_scores() for name, of_peak in details.items()
            },
            "A/E against drift time": {
                name: of_peak.ae_against_time for name, of_peak in details.items()
            },
        },
        "ae_energy": ae_against_energy(sim_set, data_set, amplitudes, recipe),
        "drift_slices": {name: of_peak.slice_table for name, of_peak in details.items()},
        "noise": {name: _noise(peaks[name]["noise"]) for name in details},
        "linearity": _linearity(ren, max(scored, key=lambda peak: len(peak.sim_rows)), seed),
        "baseline_methods": {
            "fits": {name: method.describe() for name, method in others.methods.items()},
            "missing": others.missing,
        },
        "training": {
            "recipe": recipe.name,
            "seconds": run.seconds,
            "device": run.device,
            "seed": run.seed,
            "peak": run.peak,
        },
        "tails": None if known is None else known.model_dump(exclude_unset=True),
        "rejections": {
            "sim": sim_set.prepared.rejections,
            "data": data_set.prepared.rejections,
        },
    }
    metrics["verdicts"] = {"summary": _summary(metrics), "table": verdict_table(metrics)}
    return Evaluation(ren, iren, run, sim_set, data_set, sets, values, details, metrics)


def _load_both(
    ren: REN,
    sim: PulseFile,
    data: PulseFile,
    names: list[str],
    max_pulses: int,
) -> tuple[InputSet, InputSet]:
    selection = validation_selection(names, ren.recipe)
    sim_set = load_pulses(sim, "simulated", ren.recipe, selection, max_pulses=max_pulses)
    data_set = load_pulses(data, "measured", ren.recipe, selection, max_pulses=max_pulses)
    require_same_sampling(sim_set, data_set)
    if not np.isclose(sim_set.dt_ns, ren.dt_ns):
        raise CpunetError(
            f"{sim_set.path}: sampled every {sim_set.dt_ns:g} ns, the run was trained on "
            f"{ren.dt_ns:g} ns; resample the pulses"
        )
    return sim_set, data_set


def _scores(
    sets: Sequence[PeakSets], recipe: Recipe, seed: int
) -> tuple[dict[str, ByMethod], dict[str, Any]]:
    """Parameters by peak and method, and the scores of each peak."""
    values: dict[str, ByMethod] = {}
    scores: dict[str, Any] = {}
    with stage("Scoring", len(sets)) as bar:
        for peak in sets:
            values[peak.name], scores[peak.name] = score_peak(peak, recipe, seed)
            bar.update(1)
    return values, scores


def _details(
    scored: Sequence[PeakSets],
    values: Mapping[str, ByMethod],
    recipe: Recipe,
    seed: int,
) -> dict[str, PeakDetails]:
    """Further comparisons of each scored peak."""
    details, bootstraps = {}, recipe.scores.bootstraps
    with stage("Comparing in detail", len(scored)) as bar:
        for peak in scored:
            details[peak.name] = peak_details(peak, values[peak.name], bootstraps, seed)
            bar.update(1)
    return details


def _compared(run: Run, sim: InputSet, data: InputSet) -> dict[str, Any]:
    """Description of the compared inputs, shown before the scores."""
    training = (
        f"recipe {run.recipe.name} on {run.peak}",
        "" if run.seed is None else f"seed {run.seed}",
        f"{run.sim.used} simulated and {run.data.used} measured pulses",
        run.started[:10],
    )
    known = {
        "detector": sim.detector,
        "channel": data.read_as.get("table"),
        "period": period_of(data.path),
    }
    compared = {name: str(value) for name, value in known.items() if value is not None}
    compared |= {
        "simulation": _short(sim.path),
        "data": _short(data.path),
        "run": Path(run.name).absolute().name,
        "trained": ", ".join(filter(None, training)),
    }
    if run.fit is not None and run.fit.verdict:
        compared["fit"] = run.fit.verdict
    return compared | {"scored with": f"cpunet {cpunet.__version__}"}


def period_of(path: Path) -> str | None:
    """Period and run in a file name of LEGEND; None for other names.

    Examples
    --------
    >>> period_of(Path("l200-p03-r001-cal-20230318T012144Z-tier_raw.lh5"))
    'p03 r001'
    """
    found = re.match(r"l\d+-(p\d\d)-(r\d{3})-", path.name)
    return None if found is None else f"{found[1]} {found[2]}"


def _short(path: Path) -> str:
    """Name of a file and its folder, which do not depend on where a study is stored."""
    return "/".join(path.absolute().parts[-2:])


def _linearity(ren: REN, peak: PeakSets, seed: int) -> dict[str, Any]:
    """Difference between the translation of a sum and the sum of the translations."""
    found = linearity_residual(
        lambda windows: ren.apply(windows, noise=False),
        peak.raw.waveforms,
        np.random.default_rng(seed),
        PAIRS,
        edge_samples=ren.recipe.scores.edge_samples,
    )
    return {"peak": peak.name} | found


def _noise(spectra: Mapping[str, Any]) -> dict[str, Any]:
    """RMS of the noise by method, without the spectrum."""
    sizes, judged = ("n", "samples", "rms", "rms_std"), ("rms_ratio", "sigma")
    shown = (*sizes, *judged, "worst_band_sigma", "spectrum_sigma", "missing")
    return {
        method: {key: found[key] for key in shown if key in found}
        for method, found in spectra.items()
        if method != "frequency_mhz"
    }


def _summary(metrics: Mapping[str, Any]) -> list[str]:
    """First lines of the report: verdict on the translation by peak."""
    found = summaries(metrics)
    return [of_peak["ren"] for of_peak in found.values() if "ren" in of_peak]
