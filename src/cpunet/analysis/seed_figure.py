"""Dependence of the scores on the seed of a training (paper, section on uncertainty)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from cpunet.analysis.seed_scores import scored
from cpunet.analysis.style import COLOURS, label, styled
from cpunet.analysis.verdicts import number, part
from cpunet.errors import CpunetError
from cpunet.pulses.parameters import PARAMETERS

MAX_BARS = 30  # bars are 1 % wide, or wider if there would be more

Scores = dict[str, dict[str, dict[str, Any]]]


def seed_distributions(metrics: Sequence[Mapping[str, Any]]) -> Scores:
    """IoU of each peak and parameter over trainings that differ in their seed.

    Parameters
    ----------
    metrics
        Content of the ``metrics.json`` of each training, validated on the same pulses.

    Returns
    -------
    dict
        By peak and parameter: ``iou``, all known scores in percent; ``missing``, the number of
        trainings without one; ``median`` of the scores; ``ceiling`` and ``ceiling_std``, means
        over the trainings.  The last three are None where no training has them.

    Raises
    ------
    CpunetError
        If there are no metrics, or none of them has a scored peak.
    """
    if not metrics:
        raise CpunetError("no scores of trainings to compare; give one metrics.json or more")
    places = scored(metrics)
    if not places:
        raise CpunetError("none of the trainings has a scored peak; validate with more pulses")
    result: Scores = {}
    for peak, parameter in places:
        of_runs = [part(run, "peaks", peak, "parameters", parameter) for run in metrics]
        result.setdefault(peak, {})[parameter] = _row(of_runs)
    return result


@styled
def seed_figure(distributions: Scores) -> Figure:
    """Histograms of the IoU over seeds, one row per peak and one column per parameter.

    Parameters
    ----------
    distributions
        Result of `seed_distributions`.
    """
    peaks = list(distributions)
    names = list(dict.fromkeys(name for rows in distributions.values() for name in rows))
    figure = Figure(figsize=(0.8 + 3.1 * len(names), 0.9 + 2.4 * len(peaks)))
    grid = figure.subplots(len(peaks), len(names), squeeze=False)
    for i, peak in enumerate(peaks):
        for j, name in enumerate(names):
            _panel(grid[i, j], distributions[peak].get(name))
            title = PARAMETERS[name].label if name in PARAMETERS else name
            grid[i, j].set_title(f"{peak}, {title}")
        grid[i, 0].set_ylabel("Trainings")
    for axes in grid[-1]:
        axes.set_xlabel(f"IoU of {label('ren')} [%]")
    _legend(figure)
    return figure


def _row(of_runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    def known(*keys: str) -> list[float]:
        found = [number(run, *keys) for run in of_runs]
        return [value for value in found if value is not None]

    iou = known("iou", "ren")
    ceilings, spreads = known("iou", "ceiling"), known("iou_std", "ceiling")
    return {
        "iou": iou,
        "missing": len(of_runs) - len(iou),
        "median": float(np.median(iou)) if iou else None,
        "ceiling": float(np.mean(ceilings)) if ceilings else None,
        "ceiling_std": float(np.mean(spreads)) if spreads else None,
    }


def _panel(axes: Axes, row: Mapping[str, Any] | None) -> None:
    if row is None or not row["iou"]:
        axes.text(0.5, 0.5, "no scores", ha="center", transform=axes.transAxes)
        axes.set(xticks=[], yticks=[])
        return
    iou = np.array(row["iou"])
    low, high = np.floor(iou.min()), np.floor(iou.max()) + 1
    width = np.ceil((high - low) / MAX_BARS)
    counts, edges = np.histogram(iou, np.arange(low, high + width, width))
    axes.stairs(counts, edges, fill=True, facecolor=COLOURS["ren"], alpha=0.35)
    axes.plot(iou, np.zeros(len(iou)), "|", color=COLOURS["ren"], markersize=11, clip_on=False)
    axes.axvline(row["median"], color=COLOURS["ren"])
    if row["ceiling"] is not None:
        spread = row["ceiling_std"] or 0.0
        axes.axvspan(row["ceiling"] - spread, row["ceiling"] + spread, color="0.85", zorder=0)
        axes.axvline(row["ceiling"], color="0.5", linewidth=1.0, zorder=0.5)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(0, 1.25 * counts.max())  # space for the note
    note = f"n = {len(iou)}" + (f", {row['missing']} missing" if row["missing"] else "")
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}  # hides lines behind the text
    axes.text(0.02, 0.97, note, transform=axes.transAxes, va="top", size=8, bbox=box)


def _legend(figure: Figure) -> None:
    handles = [
        Patch(color=COLOURS["ren"], alpha=0.35, label="Trainings, by seed"),
        Line2D([], [], color=COLOURS["ren"], label="Median"),
        Patch(color="0.85", label="Ceiling ± its error"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles))
