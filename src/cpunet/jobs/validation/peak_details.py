"""Comparisons beyond distributions: slices of rise time, A/E, two dimensions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from cpunet.analysis.ae_details import ae_against_drift_time, two_dimensional
from cpunet.analysis.drift_slices import (
    Slices,
    slice_edges,
    slice_table,
    superpulses,
)
from cpunet.analysis.style import NO_NOISE
from cpunet.errors import CpunetError
from cpunet.jobs.validation.peak_sets import PeakSets
from cpunet.jobs.validation.scoring import ByMethod

# samples of a superpulse before and after half maximum
BEFORE, AFTER = 100, 150
# entries of the two-dimensional comparison in tables; counts are only for the figure
_TWO_DIMENSIONAL = ("iou", "iou_std", "missing")


@dataclass(frozen=True, eq=False)
class PeakDetails:
    """Further comparisons of one peak, each with a figure.

    Parameters
    ----------
    slices
        Superpulses by method; empty if they cannot be made.
    slice_table, ae_against_time, plane
        Results of `slice_table`, `ae_against_drift_time` and `two_dimensional`, or
        ``missing`` with the reason.
    """

    slices: Mapping[str, Slices] = field(default_factory=dict)
    slice_table: Mapping[str, Any] = field(default_factory=dict)
    ae_against_time: Mapping[str, Any] = field(default_factory=dict)
    plane: Mapping[str, Any] = field(default_factory=dict)

    def plane_scores(self) -> dict[str, Any]:
        """The two-dimensional comparison without its counts."""
        return {key: self.plane[key] for key in _TWO_DIMENSIONAL if key in self.plane}


def peak_details(peak: PeakSets, values: ByMethod, bootstraps: int, seed: int) -> PeakDetails:
    """Compare a peak's pulses in slices of rise time, and A/E with drift time.

    Parameters
    ----------
    peak
        Pulses of the peak.
    values
        Parameters by method, see `cpunet.jobs.validation.scoring.score_peak`; methods
        without noise are left out.
    bootstraps, seed
        Number and seed of the bootstraps for the errors.
    """
    noisy = {m: v for m, v in values.items() if not m.endswith(NO_NOISE)}
    amplitude = {m: v["current_amplitude"] for m, v in noisy.items()}
    time = {m: v["drift_time"] for m, v in noisy.items()}
    slices, table = _slices(peak, noisy)
    return PeakDetails(
        slices=slices,
        slice_table=table,
        ae_against_time=ae_against_drift_time(amplitude, time),
        plane=two_dimensional(amplitude, time, bootstraps=bootstraps, seed=seed),
    )


def _slices(peak: PeakSets, values: ByMethod) -> tuple[dict[str, Slices], dict[str, Any]]:
    windows = peak.by_method()
    times = {method: of_method["rise_01_90"] for method, of_method in values.items()}
    try:
        edges = slice_edges(times["data"])
    except CpunetError as error:
        return {}, {"missing": str(error)}
    slices = {
        method: superpulses(windows[method].waveforms, time, edges, BEFORE, AFTER)
        for method, time in times.items()
    }
    return slices, slice_table(slices, peak.dt_ns)
