"""Figures of mean pulses and of single ones, with their differences from the data.

It is unknown which simulated and which measured pulses come from the same position.  A
simulated pulse is therefore shown beside the measured one nearest to its translation.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from cpunet.plotting import (
    COLOURS,
    GROUP,
    STACKED,
    label,
    legend_above,
    line_look,
    panels,
    styled,
)
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import align_half_maximum
from cpunet.validation.slices import AFTER, BEFORE, MeanPulse

LINEAR = 0.1  # percent of full charge, up to which the scale of the differences is linear


@styled
def shape_figure(
    columns: Mapping[str, Mapping[str, MeanPulse]], dt_ns: float, title: str
) -> Figure:
    """Pulses aligned at half maximum (top) and differences from the data (bottom), by column.

    Bands are standard errors.  The simulation is scaled to the height of the data, which would
    dominate the difference.

    Parameters
    ----------
    columns
        Pulses by method in each column, the measured one under ``"data"``; drawn in this
        order, later ones on top.
    dt_ns
        Sampling period in ns.
    title
        Title of the figure.
    """
    methods, n = list(next(iter(columns.values()))), len(columns)
    per_line = len(methods) if n > 1 else 3
    width = 2.0 + 2.7 * n if n > 1 else 5.6
    figure, grid = panels((width, 4.9), 2, n, sharey="row", **STACKED)
    for (above, below), (name, pulses) in zip(grid.T, columns.items(), strict=True):
        data = pulses["data"]
        time_ns = dt_ns * np.arange(-BEFORE, len(data.mean) - BEFORE, dtype=float)
        for method, pulse in pulses.items():
            mean, look = pulse.mean, line_look(method)
            if method == "raw":
                mean = mean * (data.mean[-1] / mean[-1])
            above.plot(time_ns, mean, label=label(method), **look)
            if method != "data":
                middle = 100 * (mean - data.mean)
                error = 100 * np.hypot(pulse.error, data.error)
                band = {"color": COLOURS[method], "gid": GROUP + method, "alpha": 0.2, "lw": 0}
                below.plot(time_ns, middle, **look)
                below.fill_between(time_ns, middle - error, middle + error, **band)
        counts = "n = " + ", ".join(str(pulse.n) for pulse in pulses.values())
        if data.n > 1:
            above.text(0.97, 0.03, counts, ha="right", transform=above.transAxes, size=8)
        above.set(title=name, xlim=(time_ns[0], time_ns[-1]))
        below.axhline(0, color="black", linewidth=0.8)
        below.set_xlabel("Time from half maximum [ns]")
    # small differences show beside those of an untranslated simulation
    grid[1, 0].set_yscale("symlog", linthresh=LINEAR)
    grid[1, 0].yaxis.set_major_formatter("{x:g}")
    grid[1, 0].set_ylabel(f"Method − data\n[% of full charge,\nlinear within ± {LINEAR:g}]")
    grid[0, 0].set_ylabel("Pulse height")
    legend_above(figure, grid[0, 0], per_line, title)
    return figure


def nearest(windows: FloatArray, target: FloatArray) -> tuple[int, float]:
    """The pulse with the smallest RMS difference from another, both aligned at half maximum.

    Noise contributes to the difference.  Pulses with less than half of the compared samples
    in their record are left out.

    Parameters
    ----------
    windows
        Pulses to choose from, shape ``(n, length)``.
    target
        Aligned pulse to compare with, shape ``(BEFORE + AFTER + 1,)``.

    Returns
    -------
    tuple
        Row of the pulse, and its RMS difference from 100 samples before the crossing to 150
        after it, in pulse heights.

    Examples
    --------
    >>> time = np.arange(400.0)
    >>> pulses = np.array([1 / (1 + np.exp((200 - time) / width)) for width in (2, 5, 9)])
    >>> nearest(pulses, align_half_maximum(pulses, BEFORE, AFTER)[1])[0]
    1
    """
    aligned = align_half_maximum(windows, BEFORE, AFTER)
    apart = np.square(aligned - target.astype(float))
    known = np.isfinite(apart)
    mean = np.where(known, apart, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    enough = np.isfinite(aligned).sum(axis=1) >= 0.5 * np.isfinite(target).sum()
    squares = np.where(enough & known.any(axis=1), mean, np.inf)
    row = int(squares.argmin())
    return row, float(np.sqrt(squares[row]))
