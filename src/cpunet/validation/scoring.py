"""Scores of a peak: distributions, single pulses, noise, classifier test; survival of all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from cpunet.errors import CpunetError
from cpunet.plotting import NO_NOISE
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import PARAMETERS, Values
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.recipes.schema import Recipe
from cpunet.validation.a_over_e import survival_table
from cpunet.validation.baseline_spectra import baseline_spectra
from cpunet.validation.comparisons import compare
from cpunet.validation.peak_sets import PeakSets
from cpunet.validation.two_sample import classifier_auc

TESTED = 1000  # pulses per side: resolves an AUC to 0.013

ByMethod = dict[str, dict[str, Values]]


def score_peak(peak: PeakSets, recipe: Recipe, seed: int) -> tuple[ByMethod, dict[str, Any]]:
    """Compare the pulses of a peak, method by method.

    Parameters
    ----------
    peak
        Pulses of the peak.
    recipe
        Recipe of the run.
    seed
        Seed of bootstraps and folds.

    Returns
    -------
    values
        Pulse-shape parameters by method and name: all of `SHAPE_PARAMETERS`, or only those
        of `PARAMETERS` for methods without noise.  Empty if the peak is not scored.
    scores
        Entry of the peak in ``metrics.json``, ready for JSON.
    """
    scores: dict[str, Any] = {
        "n_sim": len(peak.sim_rows),
        "n_data": len(peak.data_rows),
        "not_prepared": peak.not_prepared(),
    }
    missing = peak.missing()
    if missing is not None:
        return {}, scores | {"parameters": {}, "missing": missing}
    pulses = peak.by_method()
    values = {
        method: all_parameters(
            of_method,
            recipe.preparation,
            recipe.scores,
            amplitudes=peak.amplitudes_of(method),
        )
        for method, of_method in pulses.items()
    } | peak.noise_free_parameters()
    chief = {method: {name: v[name] for name in PARAMETERS} for method, v in values.items()}
    scores["two_sample"] = told_apart(pulses, chief, seed)
    scores["parameters"] = _compared(chief, recipe, seed)
    further = {
        method: {name: v for name, v in of_method.items() if name not in PARAMETERS}
        for method, of_method in values.items()
        if not method.endswith(NO_NOISE)
    }
    scores["further"] = _compared(further, recipe, seed)
    align, dt_ns = recipe.preparation.samples_before, peak.dt_ns
    scores["noise"] = baseline_spectra(
        {
            method: of_method.waveforms[:, : recipe.preparation.baseline_samples].copy()
            for method, of_method in pulses.items()
        },
        {method: align + values[method]["t01"] / dt_ns for method in pulses},
        recipe.preparation.baseline_samples,
        dt_ns,
    )
    paired = peak.paired_scores()
    if paired is not None:
        scores["paired"] = paired
    return values, scores


def _compared(values: ByMethod, recipe: Recipe, seed: int) -> dict[str, Any]:
    methods: Mapping[str, Mapping[str, Values]] = {
        method: of_method for method, of_method in values.items() if method != "data"
    }
    return dict(compare(values["data"], methods, recipe.scores, seed))


def told_apart(pulses: Mapping[str, Pulses], values: ByMethod, seed: int) -> dict[str, Any]:
    """Classifier test between each method and the data, for one peak.

    Parameters
    ----------
    pulses
        Prepared pulses with noise by method, including ``"data"``.
    values
        Pulse-shape parameters of the pulses.
    seed
        Seed of the folds.

    Returns
    -------
    dict
        Fields of `cpunet.validation.two_sample.TwoSample` by method, or ``missing`` with the
        reason.
    """
    tested: dict[str, Any] = {}
    data = pulses["data"].waveforms
    for method, others in pulses.items():
        if method == "data":
            continue
        try:
            result = classifier_auc(
                data,
                others.waveforms,
                seed=seed,
                features=(values["data"], values[method]),
                largest=TESTED,
            )
        except CpunetError as error:
            tested[method] = {"missing": str(error)}
        else:
            tested[method] = asdict(result)
    return tested


def survivals(values: Mapping[str, ByMethod], seed: int) -> dict[str, Any]:
    """A/E survival of all peaks and methods after cuts at 90 % of the DEP.

    Parameters
    ----------
    values
        Parameters by peak and method, including ``"data"``; empty for peaks that are not
        scored.
    seed
        Seed of the bootstraps for the errors.

    Returns
    -------
    dict
        Result of `cpunet.validation.a_over_e.survival_table`, or ``missing`` with the reason.
    """
    amplitudes = {
        peak: {method: v["current_amplitude"] for method, v in by_method.items()}
        for peak, by_method in values.items()
        if by_method
    }
    methods = set.intersection(*(set(found) for found in amplitudes.values()))
    by_method = {
        method: {peak: found[method] for peak, found in amplitudes.items()}
        for method in next(iter(amplitudes.values()))
        if method in methods
    }
    try:
        return dict(survival_table(by_method.pop("data"), by_method, seed=seed))
    except CpunetError as error:
        return {"missing": str(error)}
