"""A/E in detail: against the drift time, and jointly with it.

The distribution of the current amplitude can agree although its dependence on the position
in the detector does not, since deviations can cancel.  Amplitudes are those of prepared
pulses, so they are A/E (see `cpunet.validation.a_over_e`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import hist
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.binning import data_axis
from cpunet.validation.comparisons import ceiling, iou, iou_error
from cpunet.validation.resampling import Resampled, resampled_twice

Values = npt.NDArray[np.float64]

QUANTILES = {"q16": 0.16, "median": 0.5, "q84": 0.84}
MIN_PULSES = 10  # minimum events of a bin for errors of its quantiles
TIME_BINS = 8
EVENTS_PER_CELL = 10  # with fewer, resampled data agree better than independent data
MAX_BINS = 25


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
        Only ``missing`` if no measured pulse has both values.

    Raises
    ------
    CpunetError
        If the arrays of a method differ in length.
    """
    known = {
        method: _finite_pairs(method, values, drift_time[method])
        for method, values in amplitude.items()
    }
    measured = known["data"][1]
    if not measured.size:
        return {"missing": "no measured pulse has an amplitude and a drift time"}
    edges = np.quantile(measured, np.linspace(0, 1, bins + 1))
    methods, left_out = {}, {}
    for method, (ae, time) in known.items():
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


def two_dimensional(
    amplitude: Mapping[str, Values],
    drift_time: Mapping[str, Values],
    *,
    bootstraps: int = 100,
    seed: int | np.random.Generator = 0,
) -> dict[str, Any]:
    """Overlap of the joint distributions of A/E and drift time.

    Both axes are those of the data (`comparisons.data_axis`), with as many bins as leave ten
    events per cell in the smallest dataset.  Underflow and overflow have cells of their own.

    Parameters
    ----------
    amplitude, drift_time
        A/E and drift times by method, see `ae_against_drift_time`.
    bootstraps, seed
        Number and seed of the bootstraps for the ceiling and the errors.

    Returns
    -------
    dict
        JSON-ready:

        ``amplitude_edges``, ``time_edges_ns``
            edges of the inner cells.
        ``iou``, ``iou_std``
            in percent, by method and for the ``ceiling`` (see `comparisons.ceiling`), which
            here is one to three points too high, since resampled data fill the same cells.
        ``counts``
            counts in the inner cells, amplitude by time, by method including ``data``.
        ``outside``, ``undefined``
            number of events in the outer cells, and without a finite value, by method.

        Or ``missing`` with the reason, if the data or a method have too few events.

    Raises
    ------
    CpunetError
        If the arrays of a method differ in length.
    """
    known = {m: _finite_pairs(m, values, drift_time[m]) for m, values in amplitude.items()}
    smallest = min(known, key=lambda method: len(known[method][0]))
    n = len(known[smallest][0])
    bins = min(MAX_BINS, int(np.sqrt(n / EVENTS_PER_CELL)))
    if bins < 2:
        return {
            "missing": f"{smallest} has {n} events "
            f"(at least {4 * EVENTS_PER_CELL} are needed for two bins an axis)"
        }
    axes = tuple(data_axis(values, bins) for values in known["data"])
    cells = {m: _cells(amplitude[m], drift_time[m], axes) for m in amplitude}
    cell_axis = hist.axis.Regular(n_cells := _count(axes), -0.5, n_cells - 0.5)
    rng = np.random.default_rng(seed)
    counts = {m: _counts(places, axes) for m, places in cells.items()}
    return {
        "amplitude_edges": axes[0].edges.tolist(),
        "time_edges_ns": axes[1].edges.tolist(),
        **_overlaps(cells, cell_axis, bootstraps, rng),
        "counts": {m: c.tolist() for m, c in counts.items()},
        "outside": {m: len(known[m][0]) - int(c.sum()) for m, c in counts.items()},
        "undefined": {m: len(amplitude[m]) - len(known[m][0]) for m in amplitude},
    }


def _finite_pairs(method: str, ae: Values, time: Values) -> tuple[Values, Values]:
    if ae.shape != time.shape:
        raise CpunetError(
            f"{method}: {len(ae)} amplitudes beside {len(time)} drift times; give one for each"
        )
    known = np.isfinite(ae) & np.isfinite(time)
    return ae[known], time[known]


def _bin(ae: Values, time: Values) -> dict[str, Any]:
    n = len(ae)
    if n < MIN_PULSES:
        return {"n": n, "missing": f"{n} events (at least {MIN_PULSES} are needed)"}
    row: dict[str, Any] = {"n": n, "time_ns": float(np.median(time))}
    for name, p in QUANTILES.items():
        # scatter of the rank of a quantile, which is independent of the distribution
        stray = np.sqrt(p * (1 - p) / n)
        low, high = np.quantile(ae, np.clip([p - stray, p + stray], 0, 1))
        row |= {name: float(np.quantile(ae, p)), f"{name}_error": float((high - low) / 2)}
    return row


def _count(axes: tuple[hist.axis.Regular, ...]) -> int:
    return int(np.prod([axis.size + 2 for axis in axes]))


def _cells(ae: Values, time: Values, axes: tuple[hist.axis.Regular, ...]) -> Values:
    """Number of each event's cell, including outer cells; NaN if it has none."""
    known = np.isfinite(ae) & np.isfinite(time)
    cells = np.full(len(ae), np.nan)
    row, column = (
        np.searchsorted(axis.edges, values[known], side="right")
        for axis, values in zip(axes, (ae, time), strict=True)
    )
    cells[known] = row * (axes[1].size + 2) + column
    return cells


def _counts(cells: Values, axes: tuple[hist.axis.Regular, ...]) -> npt.NDArray[np.int64]:
    """Number of events in the inner cells, amplitude by time."""
    known = cells[np.isfinite(cells)].astype(int)
    shape = [axis.size + 2 for axis in axes]
    return np.bincount(known, minlength=_count(axes)).reshape(shape)[1:-1, 1:-1]


def _overlaps(
    cells: Mapping[str, Values],
    axis: hist.axis.Regular,
    bootstraps: int,
    rng: np.random.Generator,
) -> dict[str, dict[str, float]]:
    data = cells["data"]
    methods = {m: values for m, values in cells.items() if m != "data"}
    n_sim = max(map(len, methods.values()), default=len(data))
    null = resampled_twice(len(data), n_sim, len(data), bootstraps, rng)
    mean, std = ceiling(data, axis, null)
    errors = {
        m: iou_error(data, v, axis, (null[1], Resampled.of(len(v), len(v), bootstraps, rng)))
        for m, v in methods.items()
    }
    return {
        "iou": {m: iou(data, v, axis) for m, v in methods.items()} | {"ceiling": mean},
        "iou_std": errors | {"ceiling": std},
    }
