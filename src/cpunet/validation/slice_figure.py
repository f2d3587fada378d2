"""Superpulses in slices of rise time, and their differences from the data by method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cpunet.plotting import GROUP, colours, label, line_look, linear_within, styled
from cpunet.validation.drift_slices import Slices, Values, slice_residuals

LINEAR = 0.1  # percent of full charge, up to which the scale of the residuals is linear


@styled
def slice_figure(sets: Mapping[str, Slices], dt_ns: float, peak: str) -> Figure:
    """Superpulses (top) and residuals with error bands (bottom), one column per slice.

    Parameters
    ----------
    sets
        Superpulses by method, the measured ones under ``"data"``; drawn in this order, later
        ones on top.
    dt_ns
        Sampling period in ns.
    peak
        Name of the gamma line, for the title.

    Raises
    ------
    CpunetError
        If the datasets differ in their slices or their window.
    """
    data = sets["data"]
    n = len(data.pulses)
    figure = Figure(figsize=(2.0 + 2.7 * n, 4.9))
    grid = figure.subplots(2, n, sharex=True, sharey="row", height_ratios=(3, 2), squeeze=False)
    time_ns: Values = dt_ns * np.arange(
        -data.before, len(data.pulses[0].mean) - data.before, dtype=float
    )
    palette = colours(sets)
    for i, axes in enumerate(grid[0]):
        low, high = data.edges[i : i + 2]
        axes.set_title(f"{low:.0f} … {high:.0f} ns")
        for method, slices in sets.items():
            if slices.pulses[i].n:
                look = line_look(method, palette[method])
                axes.plot(time_ns, slices.pulses[i].mean, label=label(method), **look)
        counts = ", ".join(str(slices.pulses[i].n) for slices in sets.values())
        axes.text(0.97, 0.03, f"n = {counts}", ha="right", transform=axes.transAxes, size=8)
    for method, slices in sets.items():
        if method != "data":
            _bands(list(grid[1]), data, slices, time_ns, palette[method], GROUP + method)
    _label(figure, grid[0, 0], list(grid[1]), peak)
    grid[0, 0].set_xlim(time_ns[0], time_ns[-1])
    return figure


def _bands(
    panels: list[Axes], data: Slices, own: Slices, time_ns: Values, colour: str, group: str
) -> None:
    for axes, residual in zip(panels, slice_residuals(data, own), strict=True):
        if residual is None:
            continue
        middle, error = 100 * residual.difference, 100 * residual.error
        look: dict[str, Any] = {"color": colour, "gid": group}
        axes.plot(time_ns, middle, linewidth=1.0, **look)
        axes.fill_between(time_ns, middle - error, middle + error, alpha=0.3, lw=0, **look)


def _label(figure: Figure, first: Axes, below: list[Axes], peak: str) -> None:
    for axes in below:
        axes.axhline(0, color="black", linewidth=0.8)
        axes.set_xlabel("Time from half maximum [ns]")
    linear_within(below[0], LINEAR)
    below[0].set_ylabel(f"Method − data\n[% of full charge,\nlinear within ± {LINEAR:g}]")
    first.set_ylabel("Pulse height")
    handles, names = first.get_legend_handles_labels()
    figure.legend(
        handles,
        names,
        loc="outside upper left",
        ncols=len(names),
        title=f"{peak}: superpulses in slices of rise time 1–90 %; bands: ±1 standard error",
        alignment="left",
    )
