"""A/E against the drift time, as a table and a figure.

The distribution of the current amplitude can agree although its dependence on the position
in the detector does not, since deviations can cancel.  Amplitudes are those of prepared
pulses, so they are A/E (see `cpunet.validation.a_over_e`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from cpunet.plotting import (
    GROUP,
    colours,
    group,
    label,
    legend_height,
    linear_within,
    panels,
    styled,
)
from cpunet.pulses.parameters import PARAMETERS

Values = npt.NDArray[np.float64]

QUANTILES = {"q16": 0.16, "median": 0.5, "q84": 0.84}
MIN_EVENTS = 10  # minimum events of a bin for errors of its quantiles
TIME_BINS = 8
LINEAR = 1.0  # percent, up to which the scale of the ratios is linear if some are large
FAR = 5  # times LINEAR: larger ratios count as large


def ae_against_drift_time(
    amplitude: Mapping[str, Values], drift_time: Mapping[str, Values], bins: int = TIME_BINS
) -> dict[str, Any]:
    """Median and 16 and 84 % quantiles of A/E in bins of the drift time, by method.

    Parameters
    ----------
    amplitude, drift_time
        A/E in pulse heights per sample and drift times in ns, by method, of equal length; those
        of the measured pulses are under ``"data"``.
    bins
        Number of bins, with equal numbers of measured pulses.

    Returns
    -------
    dict
        JSON-ready: ``edges_ns`` of the bins; ``left_out``, the number of events by method that
        are outside the edges or lack a finite amplitude or time; and ``methods``, for each
        method and the data a list of bins with ``n``, ``time_ns`` (median), and ``q16``,
        ``median`` and ``q84`` with ``…_error`` of each; or ``missing`` with the reason.
    """
    known = {m: np.isfinite(ae) & np.isfinite(drift_time[m]) for m, ae in amplitude.items()}
    edges = np.quantile(drift_time["data"][known["data"]], np.linspace(0, 1, bins + 1))
    methods, left_out = {}, {}
    for method, finite in known.items():
        ae, time = amplitude[method][finite], drift_time[method][finite]
        inside = (time >= edges[0]) & (time <= edges[-1])
        place = np.searchsorted(edges[1:-1], time, side="right")
        chosen = [inside & (place == i) for i in range(bins)]
        methods[method] = [_bin(ae[rows], time[rows]) for rows in chosen]
        left_out[method] = len(amplitude[method]) - int(inside.sum())
    return {
        "edges_ns": [float(edge) for edge in edges],
        "left_out": left_out,
        "methods": methods,
    }


@styled
def ae_figure(table: Mapping[str, Any], peak: str) -> Figure:
    """Median A/E against drift time with its error, and the range from 16 to 84 %.

    Parameters
    ----------
    table
        Result of `ae_against_drift_time`.
    peak
        Name of the gamma line, for the title.
    """
    methods = table["methods"]
    palette = colours(methods)
    figure, ((above,), (below,)) = panels(
        (6.4, 5.4),
        2,
        left=1.1,
        top=legend_height(len(methods), 3),
        between=(0, 0.15),
        sharex=True,
        height_ratios=(3, 2),
    )
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
    above.set(ylabel=PARAMETERS["current_amplitude"].axis_label)
    below.set(
        xlabel=PARAMETERS["drift_time"].axis_label, ylabel="Median,\nmethod / data − 1 [%]"
    )
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


def _bin(ae: Values, time: Values) -> dict[str, Any]:
    n = len(ae)
    if n < MIN_EVENTS:
        return {"n": n, "missing": f"{n} events (at least {MIN_EVENTS} are needed)"}
    row: dict[str, Any] = {"n": n, "time_ns": float(np.median(time))}
    for name, p in QUANTILES.items():
        # scatter of the rank of a quantile, which is independent of the distribution
        stray = np.sqrt(p * (1 - p) / n)
        low, high = np.quantile(ae, np.clip([p - stray, p + stray], 0, 1))
        row |= {name: float(np.quantile(ae, p)), f"{name}_error": float((high - low) / 2)}
    return row


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
