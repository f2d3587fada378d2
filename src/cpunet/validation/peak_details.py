"""Comparisons beyond distributions: slices of rise time, A/E against drift time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from cpunet.errors import CpunetError
from cpunet.plotting import NO_NOISE
from cpunet.pulses.half_maximum import align_half_maximum
from cpunet.pulses.parameters import Values
from cpunet.validation.ae_drift_time import ae_against_drift_time
from cpunet.validation.drift_slices import (
    Slices,
    slice_edges,
    slice_table,
    sliced,
)
from cpunet.validation.mean_pulse import MeanPulse
from cpunet.validation.peak_sets import PeakSets
from cpunet.validation.scoring import ByMethod

# samples of a superpulse before and after half maximum
BEFORE, AFTER = 100, 150


@dataclass(frozen=True, eq=False)
class PeakDetails:
    """Further comparisons of one peak, each with a figure.

    Parameters
    ----------
    means
        Mean pulses by method, of methods with pulses.
    slices
        Superpulses by method; empty if they cannot be made.
    slice_table, ae_against_time
        Results of `slice_table` and `ae_against_drift_time`, or ``missing`` with the reason.
    """

    means: Mapping[str, MeanPulse] = field(default_factory=dict)
    slices: Mapping[str, Slices] = field(default_factory=dict)
    slice_table: Mapping[str, Any] = field(default_factory=dict)
    ae_against_time: Mapping[str, Any] = field(default_factory=dict)


def peak_details(peak: PeakSets, values: ByMethod) -> PeakDetails:
    """Compare a peak's pulses in slices of rise time, and A/E with drift time.

    Parameters
    ----------
    peak
        Pulses of the peak.
    values
        Parameters by method, see `cpunet.validation.scoring.score_peak`; methods
        without noise are left out.
    """
    noisy = {m: v for m, v in values.items() if not m.endswith(NO_NOISE)}
    amplitude = {m: v["current_amplitude"] for m, v in noisy.items()}
    time = {m: v["drift_time"] for m, v in noisy.items()}
    means, slices, table = _aligned(peak, {m: v["rise_01_90"] for m, v in noisy.items()})
    return PeakDetails(
        means=means,
        slices=slices,
        slice_table=table,
        ae_against_time=ae_against_drift_time(amplitude, time),
    )


def _aligned(
    peak: PeakSets, times: Mapping[str, Values]
) -> tuple[dict[str, MeanPulse], dict[str, Slices], dict[str, Any]]:
    """Mean pulses and superpulses by method, and a table of the latter.

    Pulses are aligned once for both, one method at a time.
    """
    windows, means, slices = peak.by_method(), {}, {}
    try:
        edges = slice_edges(times["data"])
    except CpunetError as error:
        edges, table = None, {"missing": str(error)}
    for method, time in times.items():
        aligned = align_half_maximum(windows[method].waveforms, BEFORE, AFTER)
        if len(aligned):
            means[method] = MeanPulse.of_aligned(aligned, BEFORE)
        if edges is not None:
            slices[method] = sliced(aligned, time, edges, BEFORE)
    return means, slices, slice_table(slices, peak.dt_ns) if slices else table
