"""Dependence of the scores on the seed of a training (paper, section on uncertainty)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cpunet.analysis.style import COLOURS, label, styled
from cpunet.errors import CpunetError
from cpunet.pulses.parameters import PARAMETERS

MARKED = "#D55E00"
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
        By peak and parameter, JSON-ready: ``iou``, all known scores in percent;
        ``missing``, the number of trainings without one; ``median``, ``mean``, ``std``,
        ``low`` and ``high`` of the scores (None without scores; ``std`` also with only one);
        ``ceiling`` and ``ceiling_std``, means over the trainings.

    Raises
    ------
    CpunetError
        If there are no metrics, or none of them has a scored peak.
    """
    if not metrics:
        raise CpunetError("no scores of trainings to compare; give one metrics.json or more")
    places = dict.fromkeys(
        (peak, parameter)
        for run in metrics
        for peak, scores in run["peaks"].items()
        for parameter in scores["parameters"]
    )
    if not places:
        raise CpunetError("none of the trainings has a scored peak; validate with more pulses")
    result: Scores = {}
    for peak, parameter in places:
        of_runs = [_comparison(run, peak, parameter) for run in metrics]
        result.setdefault(peak, {})[parameter] = _row(of_runs)
    return result


@styled
def seed_figure(distributions: Scores, marked: Mapping[str, Any] | None = None) -> Figure:
    """Histograms of the IoU over seeds, one row per peak and one column per parameter.

    Parameters
    ----------
    distributions
        Result of `seed_distributions`.
    marked
        Metrics of one training to mark, such as the one in use.
    """
    peaks = list(distributions)
    names = list(dict.fromkeys(name for rows in distributions.values() for name in rows))
    figure = Figure(figsize=(0.8 + 3.1 * len(names), 0.9 + 2.4 * len(peaks)))
    grid = figure.subplots(len(peaks), len(names), squeeze=False)
    for i, peak in enumerate(peaks):
        for j, name in enumerate(names):
            row = distributions[peak].get(name)
            chosen = None if marked is None else _comparison(marked, peak, name)
            score = None if chosen is None else chosen["iou"].get("ren")
            _panel(grid[i, j], row, score)
            title = PARAMETERS[name].label if name in PARAMETERS else name
            grid[i, j].set_title(f"{peak}, {title}")
        grid[i, 0].set_ylabel("Trainings")
    for axes in grid[-1]:
        axes.set_xlabel(f"IoU of {label('ren')} [%]")
    _legend(figure, marked is not None)
    return figure


def _comparison(run: Mapping[str, Any], peak: str, parameter: str) -> Mapping[str, Any] | None:
    found = run["peaks"].get(peak, {}).get("parameters", {}).get(parameter)
    return found if isinstance(found, Mapping) else None


def _row(of_runs: Sequence[Mapping[str, Any] | None]) -> dict[str, Any]:
    known = [run for run in of_runs if run is not None]
    iou = _finite([run["iou"].get("ren") for run in known])
    ceilings = _finite([run["iou"].get("ceiling") for run in known])
    spreads = _finite([run["iou_std"].get("ceiling") for run in known])
    some = len(iou) > 0
    return {
        "iou": iou,
        "missing": len(of_runs) - len(iou),
        "median": float(np.median(iou)) if some else None,
        "mean": float(np.mean(iou)) if some else None,
        "std": float(np.std(iou, ddof=1)) if len(iou) > 1 else None,
        "low": min(iou, default=None),
        "high": max(iou, default=None),
        "ceiling": float(np.mean(ceilings)) if ceilings else None,
        "ceiling_std": float(np.mean(spreads)) if spreads else None,
    }


def _finite(values: Sequence[float | None]) -> list[float]:
    return [float(v) for v in values if v is not None and np.isfinite(v)]


def _panel(axes: Axes, row: Mapping[str, Any] | None, marked: float | None) -> None:
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
    if marked is not None:
        axes.axvline(marked, color=MARKED, linestyle="--")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(0, 1.25 * counts.max())  # space for the note
    note = f"n = {len(iou)}" + (f", {row['missing']} missing" if row["missing"] else "")
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}  # hides lines behind the text
    axes.text(0.02, 0.97, note, transform=axes.transAxes, va="top", size=8, bbox=box)


def _legend(figure: Figure, with_mark: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(color=COLOURS["ren"], alpha=0.35, label="Trainings, by seed"),
        Line2D([], [], color=COLOURS["ren"], label="Median"),
        Patch(color="0.85", label="Ceiling ± its error"),
    ]
    if with_mark:
        handles.append(Line2D([], [], color=MARKED, linestyle="--", label="Training in use"))
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles))
