"""Compact data of the report's interactive charts, ready for JSON.

Each function returns one entry of the ``views`` of `report.write_report`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import hist
import numpy as np
import numpy.typing as npt

from cpunet.analysis.comparisons import data_axis, histogram
from cpunet.analysis.nearest import nearest_pulses
from cpunet.analysis.paired import align_half_maximum
from cpunet.analysis.style import NO_NOISE, colours, label
from cpunet.analysis.view_parts import axis_info, packed
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import PARAMETERS, Parameter

Values = npt.NDArray[np.float64]
View = dict[str, Any]

MAX_BINS = 49
EVENTS = 20  # selectable pulses per peak
BEFORE, AFTER = 160, 240  # samples around half maximum
SEARCHED = 2000  # measured pulses searched for the nearest
POINTS = 1500  # points per method in a scatter plot
SCATTER = ("drift_time", "current_amplitude")
HOME_QUANTILES = (0.005, 0.995)  # of the data: initial range of the scatter plot
HOME_MARGIN = 0.3


def method_looks(methods: Iterable[str]) -> list[dict[str, Any]]:
    """Name, label and colour of each method, common to the whole page.

    A method without its noise has the colour of the method, is dashed, and is hidden until
    selected.

    Parameters
    ----------
    methods
        All methods of the page, in the order of the legends; duplicates are dropped.
    """
    methods = list(dict.fromkeys(methods))
    palette = colours(dict.fromkeys(m.removesuffix(NO_NOISE) for m in methods))
    return [
        {
            "name": method,
            "label": label(method),
            "colour": palette[method.removesuffix(NO_NOISE)],
            "dashed": method.endswith(NO_NOISE),
        }
        for method in methods
    ]


def distributions(
    values: Mapping[str, Mapping[str, Mapping[str, Values]]],
    comparisons: Mapping[str, Mapping[str, Mapping[str, Any]]],
    parameters_info: Mapping[str, Parameter] = PARAMETERS,
    max_bins: int = MAX_BINS,
) -> View:
    """Histograms of all parameters, in the bins of the comparison.

    Parameters
    ----------
    values
        Values by peak, method and parameter, the measured ones under ``"data"``.
    comparisons
        Results of `comparisons.compare` by peak: bins, IoU and ceiling.  Without one the
        bins are those of `comparisons.data_axis`.
    parameters_info
        Labels and units by parameter.
    max_bins
        Maximum number of bins where `comparisons` has none.

    Returns
    -------
    dict
        Histograms by peak and parameter, or ``missing`` with the reason.
    """
    return {
        peak: _peak_distributions(found, comparisons.get(peak, {}), parameters_info, max_bins)
        for peak, found in values.items()
    }


def superpulse_views(
    superpulses: Mapping[str, Mapping[str, Mapping[str, Any]]],
    slices: Mapping[str, Sequence[str]],
    dt_ns: float,
    n_before: int = BEFORE,
) -> View:
    """Mean pulses of each slice of rise time.

    Parameters
    ----------
    superpulses
        Aligned superpulses by peak and method: ``n``, the number of pulses of each slice,
        and ``mean`` and ``error`` of shape ``(slices, samples)``, in units of the full
        charge.
    slices
        Names of the slices by peak.
    dt_ns
        Sampling period in ns.
    n_before
        Sample at which the pulses are aligned.
    """
    peaks: View = {}
    for peak, methods in superpulses.items():
        if not methods:
            peaks[peak] = {"missing": "no pulses to average"}
            continue
        peaks[peak] = {
            "slices": list(slices[peak]),
            "methods": {
                method: {
                    "n": [int(count) for count in found["n"]],
                    # residuals are far smaller than the 16-bit resolution of a full pulse
                    "mean": packed(found["mean"], bits=32),
                    "error": packed(found["error"]),
                }
                for method, found in methods.items()
            },
        }
    return {"dt_ns": float(dt_ns), "before": int(n_before), "peaks": peaks}


def pulse_views(
    pulses: Mapping[str, Mapping[str, FloatArray]],
    dt_ns: float,
    measured: Mapping[str, FloatArray] | None = None,
    *,
    events: int = EVENTS,
) -> View:
    """Single events by every method, with the nearest measured pulse.

    Parameters
    ----------
    pulses
        Noise-free pulses by peak and method, shape ``(n, samples)``; each row is the same
        simulated event for all methods.
    dt_ns
        Sampling period in ns.
    measured
        Measured pulses by peak.  The nearest to an event has the smallest root-mean-square
        difference from its truth, or else from its REN translation, among at most `SEARCHED`.
    events
        Number of selectable events, equally spaced over the rows.

    Raises
    ------
    CpunetError
        If the methods of a peak have different numbers of pulses.
    """
    window = (BEFORE, AFTER)
    peaks: View = {}
    for peak, methods in pulses.items():
        clean = {method.removesuffix(NO_NOISE): found for method, found in methods.items()}
        sizes = {method: len(found) for method, found in clean.items()}
        if len(set(sizes.values())) > 1:
            raise CpunetError(f"{peak}: not the same events by all methods: {sizes}")
        finite = [np.isfinite(found).all(axis=1) for found in clean.values()]
        usable = np.flatnonzero(np.logical_and.reduce(finite)) if finite else np.array([])
        if not len(usable):
            peaks[peak] = {"missing": "no event that every method can translate"}
            continue
        rows = spread(usable, events)
        shown = {m: align_half_maximum(w[rows], *window) for m, w in clean.items()}
        found = {"rows": rows.tolist(), "usable": len(usable), "n": max(sizes.values())}
        if measured is not None and len(measured.get(peak, ())):
            found |= _nearest(shown, measured[peak], window)
        found["methods"] = {method: packed(aligned) for method, aligned in shown.items()}
        peaks[peak] = found
    return {"dt_ns": float(dt_ns), "before": BEFORE, "peaks": peaks}


def spread(rows: npt.NDArray[np.int64], events: int = EVENTS) -> npt.NDArray[np.int64]:
    """At most `events` of the rows, equally spaced."""
    places = np.linspace(0, len(rows) - 1, min(events, len(rows))).astype(int)
    return np.asarray(rows[places])


def scatter_views(
    values: Mapping[str, Mapping[str, Mapping[str, Values]]],
    parameters_info: Mapping[str, Parameter] = PARAMETERS,
) -> View:
    """Scatter plots of two parameters, with at most `POINTS` pulses per method.

    Parameters
    ----------
    values
        Values by peak, method and parameter.
    parameters_info
        Labels and units by parameter.
    """
    rng = np.random.default_rng(0)
    peaks: View = {}
    for peak, methods in values.items():
        pairs = {
            method: np.array([found[axis] for axis in SCATTER], dtype=float)
            for method, found in methods.items()
            if all(axis in found for axis in SCATTER)
        }
        if not pairs:
            peaks[peak] = {"missing": "no pulses with both parameters"}
            continue
        found: View = {"methods": {}}
        for method, pair in pairs.items():
            known = pair[:, np.isfinite(pair).all(axis=0)]
            size = known.shape[1]
            few = rng.choice(size, POINTS, replace=False) if size > POINTS else slice(None)
            chosen = known[:, few]
            found["methods"][method] = {
                "n": size,
                "missing": pair.shape[1] - size,
                "x": packed(chosen[0]),
                "y": packed(chosen[1]),
            }
        reference = pairs.get("data", next(iter(pairs.values())))
        found["home"] = [_home(row) for row in reference]
        peaks[peak] = found
    return {"axes": [axis_info(name, parameters_info) for name in SCATTER], "peaks": peaks}


def _peak_distributions(
    methods: Mapping[str, Mapping[str, Values]],
    comparisons: Mapping[str, Mapping[str, Any]],
    parameters_info: Mapping[str, Parameter],
    max_bins: int,
) -> View:
    if not methods.get("data"):
        return {"missing": "no measured pulses were scored"}
    found: View = {}
    for name, data in methods["data"].items():
        info = axis_info(name, parameters_info)
        if not np.isfinite(data).any():
            found[name] = info | {"missing": "no measured pulse has a value"}
            continue
        comparison = comparisons.get(name, {})
        axis = scored_axis(data, comparison.get("axis", {}), max_bins)
        counts = {
            method: histogram(np.asarray(values[name], dtype=float), axis).astype(int).tolist()
            for method, values in methods.items()
            if name in values
        }
        iou, errors = comparison.get("iou", {}), comparison.get("iou_std", {})
        found[name] = info | {
            "low": float(axis.edges[0]),
            "high": float(axis.edges[-1]),
            "counts": counts,
            "iou": {method: [score, errors.get(method)] for method, score in iou.items()},
        }
    return found


def scored_axis(data: Values, axis: Mapping[str, Any], max_bins: int) -> hist.axis.Regular:
    """Return the bins of a comparison's ``axis``, or those of `comparisons.data_axis`."""
    if axis.get("bins"):
        return hist.axis.Regular(int(axis["bins"]), axis["low"], axis["high"])
    return data_axis(data, max_bins)


def _nearest(
    shown: Mapping[str, FloatArray], measured: FloatArray, window: tuple[int, int]
) -> View:
    """Return the measured pulse nearest to each event."""
    to = next((m for m in ("truth", "ren") if m in shown), list(shown)[-1])
    every = measured[:: -(-len(measured) // SEARCHED)]
    found = nearest_pulses(shown[to], every, 1, window[0], least=0.5)
    if not found.index.size:
        return {}
    nearest = align_half_maximum(every[found.index[:, 0]], *window)
    searched = len(every) - found.unaligned
    return {"nearest": packed(nearest), "nearest_to": to, "searched": searched}


def _home(values: Values) -> list[float]:
    """Range of the bulk of the data, with a margin."""
    known = values[np.isfinite(values)]
    if not known.size:
        return [0.0, 1.0]
    low, high = np.quantile(known, HOME_QUANTILES)
    margin = HOME_MARGIN * (high - low) or 0.5 * abs(high) or 1.0
    return [float(low - margin), float(high + margin)]
