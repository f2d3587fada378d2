"""Figures of a training and of its validation; each function returns a `Figure`.

Only matplotlib's object-oriented interface is used.  Without global state, figures can be
made in worker processes and notebooks alike.  The caller saves them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import hist
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cpunet.errors import CpunetError
from cpunet.plotting import (
    COLOURS,
    GROUP,
    label,
    legend_above,
    line_look,
    panels,
    steps,
    styled,
)
from cpunet.pulses.parameters import PARAMETERS, Values
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS, data_axis
from cpunet.validation.comparisons import Compared, histogram

CHI_SQUARE = "chi_square"  # the only loss of a fitted chain
AVERAGED = 10  # records in the moving average
COLUMNS = 4  # panels of further parameters in a row
ROC_POINTS = 201  # points per curve
ROC_RANGE = (50, 100)  # percent of the DEP that useful cuts keep
# Panels of the loss figure: losses with their label and colour.
LOSS_PANELS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "Cycle and identity": {
        "cycle_forward": ("cycle, sim → data → sim", COLOURS["ren"]),
        "cycle_backward": ("cycle, data → sim → data", COLOURS["iren"]),
        "identity_data": ("identity, data", COLOURS["data"]),
        "identity_sim": ("identity, simulation", COLOURS["raw"]),
    },
    "Generators, adversarial": {
        "adversarial_ren": ("REN", COLOURS["ren"]),
        "adversarial_iren": ("IREN", COLOURS["iren"]),
    },
    "Discriminators": {
        "discriminator_data": ("data", COLOURS["data"]),
        "discriminator_sim": ("simulation", COLOURS["raw"]),
    },
}


@styled
def loss_curves(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Losses during the training: each record faint, the moving average on top.

    Parameters
    ----------
    records
        Records of the training log: ``{"iteration": i, "losses": {name: value, …}}``, in
        order.

    Raises
    ------
    CpunetError
        If there are no records.
    """
    if not records:
        raise CpunetError("the training log is empty: there are no losses to draw; train first")
    if CHI_SQUARE in records[0]["losses"]:
        return _chi_square_curve(records)
    iteration = np.array([record["iteration"] for record in records], dtype=float)
    figure, grid = panels((10.5, 3.6), 1, len(LOSS_PANELS))
    for axes, (title, losses) in zip(grid[0], LOSS_PANELS.items(), strict=True):
        for name, (text, colour) in losses.items():
            series = np.array([record["losses"].get(name, np.nan) for record in records], float)
            there = ~np.isnan(series)  # discriminators are not updated in every iteration
            if not there.any():
                continue
            at, series = iteration[there], series[there]
            axes.plot(at, series, color=colour, alpha=0.25, linewidth=0.7)
            width = min(AVERAGED, len(series))
            average = np.convolve(series, np.full(width, 1 / width), mode="valid")
            axes.plot(at[len(at) - len(average) :], average, colour, label=text)
        axes.set(title=title, xlabel="Iteration")
        if axes.lines:
            axes.legend()
    grid[0, 0].set(ylabel="Loss", yscale="log")
    figure.supxlabel(f"Lines: mean of {AVERAGED} records", fontsize=8, x=0.99, ha="right")
    return figure


def _chi_square_curve(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Chi-square of a fitted chain after each step of the fit."""
    figure, ((axes,),) = panels((4.6, 3.4))
    axes.plot(
        [record["iteration"] for record in records],
        [record["losses"].get(CHI_SQUARE, np.nan) for record in records],
        color="black",
        marker="o",
        markersize=3,
    )
    axes.set(xlabel="Step", ylabel="χ² of the moments", yscale="log")
    axes.set_title("Response matched to data")
    return figure


@styled
def parameter_histograms(
    values: Mapping[str, Values],
    axis: hist.axis.Regular,
    parameter: str,
    peak: str,
    comparison: Compared,
) -> Figure:
    """Distributions of one parameter: the data filled, each method as a line.

    All histograms sum to one.  The outermost bars are underflow and overflow.  The legend
    gives each method's IoU and the ceiling.

    Parameters
    ----------
    values
        Values of the parameter by method, the measured ones under ``"data"``.
    axis
        Binning, see `comparisons.data_axis`.
    parameter
        Name of the parameter in `PARAMETERS`.
    peak
        Name of the gamma line, for the title.
    comparison
        Result of `comparisons.compare` for the parameter.
    """
    # a bar at either end holds underflow and overflow
    low, high = axis.edges[[0, -1]]
    bar = max(high - low, np.spacing(high)) / 25
    edges = np.concatenate([[low - bar], axis.edges, [high + bar]])
    fractions = {m: histogram(v, axis)[:-1] / max(len(v), 1) for m, v in values.items()}
    figure, ((axes,),) = panels((5.6, 4.2))
    for method, heights in fractions.items():
        name, kind = ("ceiling", "ceiling") if method == "data" else (method, "IoU")
        score, missing = comparison["iou"].get(name), int(np.isnan(values[method]).sum())
        text = label(method) + ("" if score is None else f" ({kind} {score:.1f} %)")
        text += f", n = {len(values[method])}" + (f", {missing} undefined" if missing else "")
        steps(axes, heights, edges, method, text)
    # the outermost bars can be as high as 1 and would flatten everything in between
    top = 1.1 * max(max(h[1:-1].max() for h in fractions.values()), 1e-3)
    axes.set(
        xlabel=PARAMETERS[parameter].axis_label,
        ylabel="Fraction of events per bin",
        xlim=(edges[0], edges[-1]),
        ylim=(0, top),
    )
    _mark_flow(axes, edges, fractions)
    title = f"{peak}: bars beyond the dotted lines hold all events outside"
    legend_above(figure, axes, title=title)
    return figure


@styled
def further_histograms(
    values: Mapping[str, Mapping[str, Values]], max_bins: int, peak: str
) -> Figure:
    """Distributions of the further parameters, a small panel for each.

    Parameters
    ----------
    values
        Values by parameter and method, the measured ones under ``"data"``; of each parameter
        some measured values are finite.
    max_bins
        Maximum number of bins, see `comparisons.data_axis`.
    peak
        Name of the gamma line, for the title.
    """
    rows, methods = -(-len(values) // COLUMNS), list(next(iter(values.values())))
    figure, grid = panels((10.5, 1.9 * rows + 0.4), rows, COLUMNS)
    for axes, (name, by_method) in zip(grid.flat, values.items(), strict=False):
        axis = data_axis(by_method["data"], max_bins)
        for method, of_method in by_method.items():
            share = histogram(of_method, axis)[1:-2] / max(len(of_method), 1)
            steps(axes, share, axis.edges, method, label(method))
        axes.set(xlabel=SHAPE_PARAMETERS[name].axis_label, yticks=[])
        axes.xaxis.set_major_locator(MaxNLocator(4))
    for empty in grid.flat[len(values) :]:
        empty.set_axis_off()
    title = f"{peak}: further parameters, fraction of events per bin, in the data's range"
    legend_above(figure, grid[0, 0], len(methods), title)
    return figure


@styled
def roc_figure(ae: Mapping[str, Mapping[str, Values]], dep: str = "DEP") -> Figure:
    """Survival of other peaks after low-A/E cuts, against the survival of the DEP.

    Parameters
    ----------
    ae
        A/E of single pulses by peak and method, the measured ones under ``"data"``;
        non-finite values are left out.
    dep
        Name of the peak of single-site events.
    """
    others = [peak for peak in ae if peak != dep]
    methods = [m for m in ae[dep] if all(m in ae[peak] for peak in others)]
    size = (3.4 * len(others) + 0.6, 3.8)
    figure, (grid,) = panels(size, 1, len(others), sharey=True)
    accepted = np.linspace(0.0, 1.0, ROC_POINTS)
    for axes, peak in zip(grid, others, strict=True):
        for method in sorted(methods, key=lambda name: name == "ren"):
            single, other = (
                ae[name][method][np.isfinite(ae[name][method])] for name in (dep, peak)
            )
            if not (single.size and other.size):
                continue
            cuts = np.quantile(single, 1 - accepted)
            left = 1 - np.searchsorted(np.sort(other), cuts) / other.size
            look = line_look(method)
            axes.plot(100 * accepted, 100 * left, label=label(method), **look)
        axes.set(xlabel=f"{dep} that survives [%]", title=peak, xlim=ROC_RANGE)
    # useful cuts leave few multi-site events
    grid[0].set(ylabel="Peak that survives [%]", yscale="log", ylim=(1, 100))
    grid[0].yaxis.set_major_formatter("{x:g}")
    grid[0].yaxis.set_minor_formatter("")
    legend_above(figure, grid[0], 3)
    return figure


def _mark_flow(axes: Axes, edges: Values, fractions: Mapping[str, Values]) -> None:
    """Separate the outermost bars, and label those that exceed the axis."""
    top = axes.get_ylim()[1]
    for bar, edge, side in ((0, edges[1], "left"), (-1, edges[-2], "right")):
        axes.axvline(edge, color="0.55", linewidth=0.8, linestyle=":")
        high = [method for method, heights in fractions.items() if heights[bar] > top]
        for line, method in enumerate(high):
            axes.annotate(
                f"{100 * fractions[method][bar]:.0f} %",
                (edge, top),
                xytext=(6 if side == "left" else -6, -4 - 12 * line),
                textcoords="offset points",
                ha=side,
                va="top",
                color=COLOURS[method],
                fontsize=8.5,
                gid=GROUP + method,
            )
