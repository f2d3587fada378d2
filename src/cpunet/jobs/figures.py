"""The figures of a validation: losses, cycles, parameter distributions, mean pulses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from cpunet.analysis.comparisons import data_axis
from cpunet.analysis.figures import (
    cycle_figure,
    loss_curves,
    mean_pulses,
    parameter_histograms,
)
from cpunet.pulses.parameters import Values
from cpunet.training.loop import Record
from cpunet.translation.translator import IREN, REN

if TYPE_CHECKING:
    from cpunet.jobs.validate import PeakSets

# methods in the figures; more lines could not be told apart
DRAWN = ("data", "raw", "gauss_exp", "superpulse", "ren", "truth")
SHOWN = 10  # pulses in a figure of cycles, as in the paper


def validation_figures(
    sets: Sequence[PeakSets],
    values: Mapping[str, Mapping[str, Mapping[str, Values]]],
    scores: Mapping[str, Any],
    losses: Sequence[Record],
    ren: REN,
    iren: IREN,
) -> dict[str, Figure]:
    """Draw all figures of a validation.

    Parameters
    ----------
    sets
        Pulses by peak.
    values
        Parameters by peak and method; peaks without are left out.
    scores
        By peak, as in ``metrics.json``.
    losses
        Training records.
    ren, iren
        For the cycles.

    Returns
    -------
    dict
        Figures by name.
    """
    figures: dict[str, Figure] = {}
    scored = [peak for peak in sets if values.get(peak.name)]
    figures |= _cycles(max(scored, key=lambda s: min(len(s.raw), len(s.data))), ren, iren)
    for peak in scored:
        for parameter, comparison in scores[peak.name]["parameters"].items():
            by_method = {m: v[parameter] for m, v in values[peak.name].items() if m in DRAWN}
            if not np.isfinite(by_method["data"]).any():
                continue
            axis = data_axis(by_method["data"], ren.recipe.scores.max_bins)
            figures[f"{peak.name} {parameter}"] = parameter_histograms(
                by_method, axis, parameter, peak.name, comparison
            )
        pulses = {
            "data": peak.data.waveforms,
            "raw": peak.raw.waveforms,
            "gauss_exp": peak.others.get("gauss_exp"),
            "superpulse": peak.others.get("superpulse"),
            "ren": peak.ren.waveforms,
            "truth": peak.others.get("truth"),
        }
        figures[f"{peak.name} mean pulse"] = mean_pulses(
            {name: drawn for name, drawn in pulses.items() if drawn is not None and len(drawn)},
            ren.dt_ns,
            peak.name,
        )
    if losses:
        figures["losses"] = loss_curves(losses)
    return figures


def _cycles(peak: PeakSets, ren: REN, iren: IREN) -> dict[str, Figure]:
    """Ten pulses there and back again, in both directions."""
    sim, data = peak.raw.waveforms[:SHOWN], peak.data.waveforms[:SHOWN]
    like_data = ren.apply(sim, noise=False)
    like_sim = iren.apply(data, noise=False)
    return {
        f"{peak.name} forward cycle": cycle_figure(
            sim,
            like_data,
            iren.apply(like_data, noise=False),
            ("Simulation", "REN (simulation)", "IREN (REN (simulation))"),
            ren.dt_ns,
        ),
        f"{peak.name} backward cycle": cycle_figure(
            data,
            like_sim,
            ren.apply(like_sim, noise=False),
            ("Data", "IREN (data)", "REN (IREN (data))"),
            ren.dt_ns,
        ),
    }
