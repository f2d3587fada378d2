"""Figures of a training and of its validation; each function returns a `Figure`.

Only matplotlib's object-oriented interface is used.  Without global state, figures can be
made in worker processes and notebooks alike.  The caller saves them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import hist
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cpunet.errors import CpunetError
from cpunet.plotting import (
    COLOURS,
    GROUP,
    colours,
    label,
    legend_above,
    legend_height,
    line_look,
    linear_within,
    logarithmic,
    panels,
    stacked,
    steps,
    styled,
)
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import PARAMETERS, Values
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS, data_axis
from cpunet.validation.comparisons import Compared, histogram
from cpunet.validation.slices import BEFORE, MeanPulse

CHI_SQUARE = "chi_square"  # the only loss of a fitted chain
AVERAGES = 50  # a moving average is over this fraction of the records
DRIFT_BINS = 12  # of drift time, with as many pulses each
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
    figure, grid = panels((10.5, 3.6), 1, len(LOSS_PANELS), between=(0.5, 0))
    for axes, (title, losses) in zip(grid[0], LOSS_PANELS.items(), strict=True):
        for name, (text, colour) in losses.items():
            series = np.array([record["losses"].get(name, np.nan) for record in records], float)
            there = ~np.isnan(series)  # discriminators are not updated in every iteration
            if not there.any():
                continue
            at, series = iteration[there], series[there]
            axes.plot(at, series, color=colour, alpha=0.25, linewidth=0.7)
            width = max(1, len(series) // AVERAGES)
            average = np.convolve(series, np.full(width, 1 / width), mode="valid")
            axes.plot(at[len(at) - len(average) :], average, colour, label=text)
        axes.set(title=title, xlabel="Iteration (lines: moving averages)")
        if axes.lines:
            axes.legend()
    grid[0, 0].set(ylabel="Loss", yscale="log")
    logarithmic(grid[0, 0].yaxis)
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
    logarithmic(axes.yaxis)
    return figure


@styled
def cycle_figure(
    start: FloatArray,
    middle: FloatArray,
    end: FloatArray,
    titles: tuple[str, str, str],
    dt_ns: float,
) -> Figure:
    """Pulses through one cycle, in three panels (paper, figures of the cycles).

    Parameters
    ----------
    start, middle, end
        Pulses before, half-way through and after the cycle, shape ``(n, length)``; each
        row is the same event in all three.
    titles
        Titles of the three panels.
    dt_ns
        Sampling period in ns.
    """
    figure, grid = panels((10.5, 3.2), 1, 3, between=(0.2, 0), sharex=True, sharey=True)
    time_us = np.arange(start.shape[1]) * dt_ns * 1e-3
    shades = colormaps["viridis"](np.linspace(0, 0.9, len(start)))
    for axes, waveforms, title in zip(grid[0], (start, middle, end), titles, strict=True):
        for waveform, shade in zip(waveforms, shades, strict=True):
            axes.plot(time_us, waveform, color=shade, linewidth=1.0, rasterized=True)
        axes.set(title=title, xlabel="Time [µs]")
    grid[0, 0].set(ylabel="Pulse height [normalised]", xlim=(time_us[0], time_us[-1]))
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
    palette = colours(values)
    # a bar at either end holds underflow and overflow
    low, high = axis.edges[[0, -1]]
    bar = max(high - low, np.spacing(high)) / 25
    edges = np.concatenate([[low - bar], axis.edges, [high + bar]])
    fractions = {m: histogram(v, axis)[:-1] / max(len(v), 1) for m, v in values.items()}
    figure, ((axes,),) = panels((5.6, 4.2), top=legend_height(len(values)))
    for method, heights in fractions.items():
        name, kind = ("ceiling", "ceiling") if method == "data" else (method, "IoU")
        score, missing = comparison["iou"].get(name), int(np.isnan(values[method]).sum())
        text = label(method) + ("" if score is None else f" ({kind} {score:.1f} %)")
        text += f", n = {len(values[method])}" + (f", {missing} undefined" if missing else "")
        steps(axes, heights, edges, method, palette[method], text)
    # the outermost bars can be as high as 1 and would flatten everything in between
    top = 1.1 * max(max(h[1:-1].max() for h in fractions.values()), 1e-3)
    axes.set(
        xlabel=PARAMETERS[parameter].axis_label,
        ylabel="Fraction of events per bin",
        xlim=(edges[0], edges[-1]),
        ylim=(0, top),
    )
    _mark_flow(axes, edges, fractions, palette)
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
    figure, ((axes,),) = panels(
        (10.5, 1.9 * rows + 0.6), left=0.25, top=legend_height(1), bottom=0.1
    )
    palette = colours(methods)
    # panels of a figure each take longer to draw than their content, so they share one
    for number, (name, by_method) in enumerate(values.items()):
        axis, x, y = data_axis(by_method["data"], max_bins), number % COLUMNS, number // COLUMNS
        low, width = axis.edges[0], np.ptp(axis.edges)
        shares = {m: histogram(v, axis)[1:-2] / max(len(v), 1) for m, v in by_method.items()}
        height = max(max(share.max() for share in shares.values()), 1e-9)
        for method, share in shares.items():
            heights, edges = -y + 0.6 * share / height, x + 0.9 * (axis.edges - low) / width
            text = "" if number else label(method)
            steps(axes, heights, edges, method, palette[method], text, baseline=-y)
        for tick in MaxNLocator(4).tick_values(low, low + width):
            if low <= tick <= low + width:
                at = x + 0.9 * (tick - low) / width
                axes.plot([at, at], [-y - 0.03, -y], "k", lw=0.8)
                axes.text(
                    at, -y - 0.05, f"{tick:g}".replace("-", "−"), ha="center", va="top", size=8
                )
        axes.plot([x, x + 0.9], [-y, -y], "k", lw=0.8)
        axes.text(x + 0.45, -y - 0.28, SHAPE_PARAMETERS[name].axis_label, ha="center")
    axes.set(xlim=(-0.02, COLUMNS), ylim=(-rows + 0.65, 0.65))
    axes.set_axis_off()
    title = f"{peak}: further parameters, fraction of events per bin, in the data's range"
    legend_above(figure, axes, len(methods), title)
    return figure


@styled
def mean_pulses(sets: Mapping[str, MeanPulse], dt_ns: float, peak: str) -> Figure:
    """Mean pulses aligned at half maximum, and their differences from the data.

    Parameters
    ----------
    sets
        Mean pulses by method, the measured one under ``"data"``; methods are drawn in this
        order, later ones on top.
    dt_ns
        Sampling period in ns.
    peak
        Name of the gamma line, for the title.
    """
    palette = colours(sets)
    means = {method: averaged.mean for method, averaged in sets.items()}
    data = sets["data"]
    time_ns = (np.arange(len(data.mean)) - BEFORE) * dt_ns
    figure, above, below = stacked((5.6, 4.8))
    # the translation last, so that it is on top
    for method in sorted(means, key=lambda name: name == "ren"):
        mean, text = means[method], f"{label(method)}, n = {sets[method].n}"
        look = line_look(method, palette[method])
        above.plot(time_ns, mean, label=text, **look)
        if method == "raw":
            # its different height would dominate the difference
            mean, look["linestyle"] = mean * data.mean[-1] / mean[-1], "dashed"
            above.plot(time_ns, mean, label=f"{label(method)}, at the data's height", **look)
        if method != "data":
            below.plot(time_ns, 100 * (mean - means["data"]), **look)
    below.axhline(0, color="black", linewidth=0.8)
    above.set(title=f"{peak}, mean pulse aligned at half maximum", ylabel="Pulse height")
    above.legend(loc="lower right")
    below.set(
        xlabel="Time from half maximum [ns]",
        ylabel="Method − data\n[% of full charge,\nlinear within ± 1]",
        xlim=(time_ns[0], time_ns[-1]),
    )
    linear_within(below, 1.0)
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
    palette = colours(methods)
    size, top = (3.4 * len(others) + 0.6, 3.8), legend_height(len(methods), 3, titled=False)
    figure, (grid,) = panels(size, 1, len(others), top=top + 0.2, between=(0.3, 0), sharey=True)
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
            look = line_look(method, palette[method])
            axes.plot(100 * accepted, 100 * left, label=label(method), **look)
        axes.set(xlabel=f"{dep} that survives [%]", title=peak, xlim=ROC_RANGE)
    # useful cuts leave few multi-site events
    grid[0].set(ylabel="Peak that survives [%]", yscale="log", ylim=(1, 100))
    grid[0].yaxis.set_major_formatter("{x:g}")
    grid[0].yaxis.set_minor_formatter("")
    legend_above(figure, grid[0], 3)
    return figure


@styled
def drift_figure(before_ns: Values, longer: Values, blur_ns2: Values) -> Figure:
    """What the U-Net before a readout does, against the drift time of the simulated pulse.

    Parameters
    ----------
    before_ns, longer, blur_ns2
        As `cpunet.networks.learned_response.DriftUNet.effect` returns them, shapes (pulses,).
    """
    figure, ((left, right),) = panels((8.4, 3.4), 1, 2, between=(0.75, 0))
    edges = np.unique(np.quantile(before_ns, np.linspace(0, 1, DRIFT_BINS + 1)))
    in_bin = np.clip(np.searchsorted(edges, before_ns, "right") - 1, 0, len(edges) - 2)
    blur_ns = np.sign(blur_ns2) * np.sqrt(np.abs(blur_ns2))
    filled = np.unique(in_bin)
    for axes, values in zip((left, right), (100 * longer, blur_ns), strict=True):
        axes.plot(before_ns, values, ".", color=COLOURS["raw"], markersize=1.5, alpha=0.3)
        middle = [np.median(values[in_bin == number]) for number in filled]
        at = [np.median(before_ns[in_bin == number]) for number in filled]
        axes.plot(at, middle, color=COLOURS["ren"], marker="o", markersize=3, label="median")
        axes.axhline(0, color="black", linewidth=0.8)
        axes.set(xlabel="Simulated time from 2 to 98 % of the charge [ns]")
    left.set(ylabel="Longer by [%]", title="Clock of the U-Net")
    right.set(ylabel="Gaussian σ [ns], negative: sharpened", title="Blur of the U-Net")
    left.legend()
    return figure


def _mark_flow(
    axes: Axes, edges: Values, fractions: Mapping[str, Values], palette: Mapping[str, str]
) -> None:
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
                color=palette[method],
                fontsize=8.5,
                gid=GROUP + method,
            )
