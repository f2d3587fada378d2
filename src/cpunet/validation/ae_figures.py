"""Figures of A/E against the drift time, and of their joint distribution."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cpunet.plotting import (
    GROUP,
    colours,
    group,
    label,
    line_look,
    linear_within,
    styled,
)
from cpunet.pulses.parameters import PARAMETERS

AMPLITUDE = PARAMETERS["current_amplitude"].axis_label
DRIFT_TIME = PARAMETERS["drift_time"].axis_label
LINEAR = 1.0  # percent, up to which the scale of the ratios is linear if some are large
FAR = 5  # times LINEAR: larger ratios count as large
COLUMNS = 3  # panels per row
BAR = 0.09  # width of the colour bar beside the panels, in panel widths
ROC_POINTS = 201  # points per curve
ROC_RANGE = (50, 100)  # percent of the DEP that useful cuts keep

Values = npt.NDArray[np.float64]


@styled
def ae_figure(table: Mapping[str, Any], peak: str) -> Figure:
    """Median A/E against drift time with its error, and the range from 16 to 84 %.

    Parameters
    ----------
    table
        Result of `ae_details.ae_against_drift_time`.
    peak
        Name of the gamma line, for the title.
    """
    methods = table["methods"]
    palette = colours(methods)
    figure = Figure(figsize=(6.4, 5.4))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    ratios: list[float] = []
    for method, rows in methods.items():
        known = [row for row in rows if "missing" not in row]
        if not known:
            continue
        time, median, low, high, error = (
            np.array([row[key] for row in known], float)
            for key in ("time_ns", "median", "q16", "q84", "median_error")
        )
        look = {"color": palette[method], "marker": "o", "markersize": 3.5}
        group(above.errorbar(time, median, error, label=label(method), **look), method)
        # with one point these lines would be invisible, but widen the range of the axis
        for edge in (low, high) if len(known) > 1 else ():
            above.plot(time, edge, ":", color=palette[method], lw=1.1, gid=GROUP + method)
        if method != "data":
            points = _ratio(rows, methods["data"])
            group(below.errorbar(*points, **look), method)
            ratios += points[1]
    below.axhline(0, color="black", linewidth=0.8)
    above.set(ylabel=AMPLITUDE)
    below.set(xlabel=DRIFT_TIME, ylabel="Median,\nmethod / data − 1 [%]")
    if max(map(abs, ratios), default=0.0) > FAR * LINEAR:
        linear_within(below, LINEAR)
        below.set_ylabel(f"{below.get_ylabel()[:-1]},\nlinear within ± {LINEAR:g}]")
    figure.legend(
        *above.get_legend_handles_labels(),
        loc="outside upper left",
        ncols=3,
        title=f"{peak}: median of A/E in bins of the drift time; dotted: 16 and 84 %",
        alignment="left",
    )
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
    figure = Figure(figsize=(3.4 * max(len(others), 1) + 0.6, 3.8))
    panels = figure.subplots(1, max(len(others), 1), sharey=True, squeeze=False)[0]
    accepted = np.linspace(0.0, 1.0, ROC_POINTS)
    for axes, peak in zip(panels, others, strict=False):
        for method in sorted(methods, key=lambda name: name == "ren"):
            single, other = (_finite(ae[name][method]) for name in (dep, peak))
            if not (single.size and other.size):
                continue
            cuts = np.quantile(single, 1 - accepted)
            left = 1 - np.searchsorted(np.sort(other), cuts) / other.size
            look = line_look(method, palette[method])
            axes.plot(100 * accepted, 100 * left, label=label(method), **look)
        axes.set(xlabel=f"{dep} that survives [%]", title=peak, xlim=ROC_RANGE)
    # useful cuts leave few multi-site events
    panels[0].set(ylabel="Peak that survives [%]", yscale="log", ylim=(1, 100))
    panels[0].yaxis.set_major_formatter("{x:g}")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure


@styled
def two_dimensional_figure(table: Mapping[str, Any], peak: str) -> Figure:
    """Joint distributions of A/E and drift time, one panel per method.

    Parameters
    ----------
    table
        Result of `ae_details.two_dimensional` that is not missing.
    peak
        Name of the gamma line, for the title.
    """
    counts = {m: np.array(c, float) for m, c in table["counts"].items()}
    totals = {m: _total(table, m, c) for m, c in counts.items()}
    shares = {m: 100 * c / max(totals[m], 1) for m, c in counts.items()}
    columns = min(COLUMNS, len(shares))
    rows = -(-len(shares) // columns)
    figure = Figure(figsize=(0.9 + 3.1 * columns, 0.6 + 2.9 * rows))
    # beside the panels, in the same grid: a narrow column for the colour bar
    places = figure.add_gridspec(rows, columns + 1, width_ratios=[1] * columns + [BAR])
    panels: list[Axes] = []
    for i, j in np.ndindex(rows, columns):
        first = panels[0] if panels else None
        panels.append(figure.add_subplot(places[i, j], sharex=first, sharey=first))
        panels[-1].label_outer()
    top = shares["data"].max()
    for axes, (method, share) in zip(panels, shares.items(), strict=False):
        drawn = axes.pcolormesh(
            table["time_edges_ns"],
            table["amplitude_edges"],
            np.where(share > 0, share, np.nan),
            cmap="viridis_r",
            vmin=0,
            vmax=top,
            rasterized=True,
        )
        axes.set_gid(GROUP + method)
        axes.grid(visible=False)
        outside = 100 - share.sum()
        if not share.any():
            axes.text(
                0.5, 0.5, "no event in the\nrange of the data", transform=axes.transAxes,
                ha="center", va="center",
            )  # fmt: skip
        axes.set_title(f"{label(method)}{_score(table, method)}\n{outside:.1f} % outside")
    for axes in panels[len(shares) :]:
        axes.set_axis_off()
    _label_outer(panels[: len(shares)], columns)
    beside = figure.add_subplot(places[:, columns])
    figure.colorbar(drawn, cax=beside, label="Events per cell [%]", extend="max")
    figure.suptitle(f"{peak}: A/E and drift time", x=0.02, ha="left", fontsize=10)
    return figure


def _ratio(rows: list[Any], data: list[Any]) -> tuple[list[float], list[float], list[float]]:
    """Time, deviation of the median from that of the data in percent, and its error."""
    points: list[tuple[float, float, float]] = []
    for row, measured in zip(rows, data, strict=True):
        if "missing" in row or "missing" in measured or not measured["median"]:
            continue
        ratio = row["median"] / measured["median"]
        own = row["median_error"] / measured["median"]
        other = ratio * measured["median_error"] / measured["median"]
        points.append((row["time_ns"], 100 * (ratio - 1), 100 * float(np.hypot(own, other))))
    return [p[0] for p in points], [p[1] for p in points], [p[2] for p in points]


def _total(table: Mapping[str, Any], method: str, counts: np.ndarray[Any, Any]) -> float:
    undefined, outside = table["undefined"][method], table["outside"][method]
    return float(counts.sum() + outside + undefined)


def _score(table: Mapping[str, Any], method: str) -> str:
    name, kind = ("ceiling", "ceiling") if method == "data" else (method, "IoU")
    return f", {kind} {table['iou'][name]:.1f} ± {table['iou_std'][name]:.1f} %"


def _finite(values: Values) -> Values:
    return values[np.isfinite(values)]


def _label_outer(panels: list[Axes], columns: int) -> None:
    for i, axes in enumerate(panels):
        if i % columns == 0:
            axes.set_ylabel(AMPLITUDE)
        if i + columns >= len(panels):
            axes.set_xlabel(DRIFT_TIME)
            axes.tick_params(labelbottom=True)
