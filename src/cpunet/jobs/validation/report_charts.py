"""The data behind the interactive charts of a report."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cpunet.analysis.chart_data import (
    distributions,
    method_looks,
    pulse_views,
    scatter_views,
    spread,
    superpulse_views,
)
from cpunet.analysis.drift_slices import Slices
from cpunet.analysis.style import NO_NOISE
from cpunet.jobs.validation.evaluation import Evaluation
from cpunet.jobs.validation.peak_details import BEFORE
from cpunet.jobs.validation.peak_sets import PeakSets
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS


def report_views(found: Evaluation) -> dict[str, Any]:
    """Data of all charts, see `cpunet.analysis.chart_data`."""
    scored = [peak for peak in found.sets if found.values[peak.name]]
    # noise-free methods are shown with single pulses, where they are most informative
    values = {
        peak.name: {
            method: of_method
            for method, of_method in found.values[peak.name].items()
            if not method.endswith(NO_NOISE)
        }
        for peak in scored
    }
    comparisons = {
        name: scores["parameters"] | scores["further"]
        for name, scores in found.metrics["peaks"].items()
        if name in values
    }
    dt_ns = found.ren.dt_ns
    return {
        "methods": method_looks(method for of_peak in values.values() for method in of_peak),
        "distributions": distributions(
            values, comparisons, SHAPE_PARAMETERS, found.ren.recipe.scores.max_bins
        ),
        "slices": superpulse_views(
            {name: _packed(of_peak.slices) for name, of_peak in found.details.items()},
            {name: _slice_names(of_peak.slices) for name, of_peak in found.details.items()},
            dt_ns,
            BEFORE,
        ),
        "pulses": _pulses(scored, dt_ns),
        "scatter": scatter_views(values, SHAPE_PARAMETERS),
    }


def _pulses(scored: Sequence[PeakSets], dt_ns: float) -> dict[str, Any]:
    """Single events by every method; only displayed events are translated again."""
    chosen = {peak.name: spread(peak.known_to_all()) for peak in scored}
    views = pulse_views(
        {peak.name: peak.without_noise(chosen[peak.name]) for peak in scored},
        dt_ns,
        {peak.name: peak.data.waveforms for peak in scored},
    )
    for peak in scored:
        found = views["peaks"][peak.name]
        if "missing" not in found:
            found["rows"] = chosen[peak.name][found["rows"]].tolist()
            found["usable"], found["n"] = len(peak.known_to_all()), len(peak.sim_rows)
    return views


def _packed(slices: Mapping[str, Slices]) -> dict[str, dict[str, Any]]:
    return {
        method: {
            "n": [pulse.n for pulse in found.pulses],
            "mean": np.array([pulse.mean for pulse in found.pulses]),
            "error": np.array([pulse.error for pulse in found.pulses]),
        }
        for method, found in slices.items()
    }


def _slice_names(slices: Mapping[str, Slices]) -> list[str]:
    if not slices:
        return []
    edges = slices["data"].edges
    return [f"{low:.0f} to {high:.0f} ns" for low, high in itertools.pairwise(edges)]
