"""How much two distributions of a parameter have in common, and how much they could.

An intersection over union (IoU) of two finite samples of the *same* distribution is
less than 100 %, so each score comes with its ceiling: the IoU of the measured data
with itself, resampled at the sizes of both sets.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypedDict

import hist
import numpy as np
import numpy.typing as npt

from cpunet.analysis.distances import (
    distance_errors,
    kolmogorov_smirnov,
    null_distances,
    wasserstein,
)
from cpunet.analysis.resampling import Bins, Draws, Resampled, resampled_twice
from cpunet.errors import CpunetError
from cpunet.recipes.schema import ScoreConfig

Values = npt.NDArray[np.float64]
ByMethod = dict[str, float | None]

# Tukey's far-out fence: wide enough for both peaks of an escape line's I_max, and
# up to a quarter of the events may be outliers without moving it.
FENCE = 3.0


class Comparison(TypedDict):
    """What `compare` says of one parameter."""

    iou: ByMethod
    iou_std: ByMethod
    wasserstein: ByMethod
    wasserstein_std: ByMethod
    wasserstein_null: float | None
    wasserstein_null_std: float | None
    ks: ByMethod
    ks_std: ByMethod
    ks_null: float | None
    ks_null_std: float | None
    missing: dict[str, int]
    axis: ByMethod


def data_axis(data: Values, max_bins: int) -> hist.axis.Regular:
    """Binning of a parameter from its measured values alone.

    The axis spans the data within three interquartile ranges of the quartiles, with
    bins of the Freedman–Diaconis width, 2 IQR / ∛n.  What lies outside is counted in
    the axis' underflow and overflow bins.

    Parameters
    ----------
    data
        Measured values of one parameter; values that are not finite are ignored here.
    max_bins
        The most bins the axis may have (49 in the paper).

    Raises
    ------
    CpunetError
        If no value is finite.

    Examples
    --------
    >>> import numpy as np
    >>> axis = data_axis(np.r_[np.linspace(0, 1, 1000), 1e9], max_bins=49)
    >>> axis.size, axis.edges[[0, -1]].round(3)
    (23, array([0.   , 2.252]))
    """
    finite = data[np.isfinite(data)]
    if finite.size == 0:
        raise CpunetError("the data have no finite value to bin; check the peak's selection")
    lower, upper = np.quantile(finite, [0.25, 0.75])
    spread = upper - lower
    if spread > 0:
        low = max(finite.min(), lower - FENCE * spread)
        high = min(finite.max(), upper + FENCE * spread)
        width = 2 * spread / np.cbrt(finite.size)
        bins = int(np.clip(np.ceil((high - low) / width), 1, max_bins))
    else:
        # Half of the values are equal: one bin holds them, and the rest is outside.
        margin = 1e-3 * max(abs(lower), 1.0)
        low, high, bins = lower - margin, upper + margin, 1
    # the last edge is exclusive, and a maximum inside the fence is no overflow
    return hist.axis.Regular(bins, low, np.nextafter(high, np.inf))


def histogram(values: Values, axis: hist.axis.Regular) -> Values:
    """Counts per bin, none lost: underflow, the bins, overflow, and last the NaNs.

    Examples
    --------
    >>> import numpy as np
    >>> axis = hist.axis.Regular(2, 0, 2)
    >>> histogram(np.array([-1, 0.5, 1.5, 1.6, np.inf, np.nan]), axis)
    array([1., 1., 2., 1., 1.])
    """
    missing = np.isnan(values)
    # boost-histogram would put the NaNs into the overflow bin
    counts = hist.Hist(axis).fill(values[~missing]).values(flow=True)
    return np.append(counts, float(missing.sum()))


def iou(a: Values, b: Values, axis: hist.axis.Regular) -> float:
    """Intersection over union of two distributions, in percent (paper, section 4.3).

    Both histograms sum to one, with everything outside the axis in them.

    Parameters
    ----------
    a, b
        Values of one parameter in both sets.
    axis
        Common binning, see `data_axis`.

    Returns
    -------
    float
        0 … 100; NaN if one of the sets is empty.

    Examples
    --------
    >>> import numpy as np
    >>> axis = hist.axis.Regular(2, 0, 2)
    >>> round(iou(np.array([0.5, 1.5]), np.array([0.5, 7.0]), axis), 3)
    33.333
    """
    return float(_overlap(histogram(a, axis), histogram(b, axis)))


def ceiling(data: Values, axis: hist.axis.Regular, draws: Draws) -> tuple[float, float]:
    """IoU of the data with itself: what a perfect translation would score.

    Two sets are drawn from the data with replacement, one as large as the simulated
    set and one as large as the measured one, again and again.

    Parameters
    ----------
    data, axis
        As for `iou`.
    draws
        See `cpunet.analysis.resampling.resampled_twice`.

    Returns
    -------
    tuple of float
        Mean and standard deviation of the IoU in percent over the draws.
    """
    bins, n_bins = _bins(data, axis)
    scores = _overlap(*(of_set.counts(bins, n_bins) for of_set in draws))
    return float(scores.mean()), float(scores.std())


def iou_error(a: Values, b: Values, axis: hist.axis.Regular, draws: Draws) -> float:
    """Standard deviation, in percent, of `iou` under resampling of both sets.

    Near the ceiling it is a sixth larger than the scatter of fresh samples.  The draws are
    those of `cpunet.analysis.resampling.both_resampled`.
    """
    drawn = (d.counts(*_bins(v, axis)) for v, d in zip((a, b), draws, strict=True))
    return float(_overlap(*drawn).std())


def _bins(values: Values, axis: hist.axis.Regular) -> tuple[Bins, int]:
    """Place of each value in `histogram`, and how many places there are."""
    places = np.asarray(axis.index(values)) + 1  # type: ignore[arg-type]  # arrays, too
    return np.where(np.isnan(values), axis.size + 2, places), axis.size + 3


def compare(
    data: Mapping[str, Values],
    methods: Mapping[str, Mapping[str, Values]],
    scores: ScoreConfig,
    seed: int,
) -> dict[str, Comparison]:
    """Compare each parameter of the data with that of every method.

    Parameters
    ----------
    data
        Measured values by parameter, see `parameters.pulse_parameters`.
    methods
        The same by method: ``{"raw": …, "ren": …}`` and any others.
    scores
        Number of bins and of bootstraps.
    seed
        Of the bootstraps.

    Returns
    -------
    dict
        For each parameter, JSON-ready (``None`` where a number does not exist):

        ``iou``, ``iou_std``
            percent, by method and for the ``ceiling``.  The ceiling is that of the
            largest of the simulated sets.
        ``wasserstein``, ``ks``, ``wasserstein_std``, ``ks_std``
            of the finite values, by method; in the parameter's unit, and 0 … 1.  The
            errors are spreads over bootstraps of both sets.
        ``wasserstein_null``, ``ks_null``, ``wasserstein_null_std``, ``ks_null_std``
            one number each: what two samples of the data's own distribution have, on
            average and as spread, at the sizes of the data and of the largest of the
            simulated sets.
        ``missing``
            how many values are NaN, by method and for the ``data``.
        ``axis``
            ``low``, ``high`` and ``bins`` of the binning.

    Raises
    ------
    CpunetError
        If a method lacks a parameter of the data.
    """
    for method, values in methods.items():
        if absent := data.keys() - values.keys():
            raise CpunetError(f"{method}: parameter {min(absent)} is missing; compute it too")
    if not data:
        return {}
    # the same events of the data are drawn for all parameters and methods
    rng, n_data = np.random.default_rng(seed), len(next(iter(data.values())))
    sizes = {m: len(next(iter(values.values()))) for m, values in methods.items()}
    n_sim = max(sizes.values(), default=0)
    null = resampled_twice(n_data, n_sim, n_data, scores.bootstraps, rng)
    known = {name: values for name, values in data.items() if np.isfinite(values).any()}
    axes = {name: data_axis(values, scores.max_bins) for name, values in known.items()}
    found = {
        name: _of_data(values, list(methods), null, axes.get(name))
        for name, values in data.items()
    }
    own = null[1]
    del null
    for method, values in methods.items():
        draws = (own, Resampled.of(sizes[method], sizes[method], scores.bootstraps, rng))
        for name in data:
            _add_method(found[name], method, data[name], values[name], axes.get(name), draws)
    return found


def _of_data(
    data: Values, methods: list[str], null: Draws, axis: hist.axis.Regular | None
) -> Comparison:
    """What the data say of themselves; the methods' numbers are not there yet."""
    distances = null_distances(data, null)
    result = Comparison(
        iou=dict.fromkeys([*methods, "ceiling"]),
        iou_std=dict.fromkeys([*methods, "ceiling"]),
        wasserstein=dict.fromkeys(methods),
        wasserstein_std=dict.fromkeys(methods),
        wasserstein_null=_or_none(distances.wasserstein),
        wasserstein_null_std=_or_none(distances.wasserstein_std),
        ks=dict.fromkeys(methods),
        ks_std=dict.fromkeys(methods),
        ks_null=_or_none(distances.ks),
        ks_null_std=_or_none(distances.ks_std),
        missing={"data": int(np.isnan(data).sum())},
        axis=dict.fromkeys(("low", "high", "bins")),
    )
    if axis is not None:
        mean, std = ceiling(data, axis, null)
        result["iou"]["ceiling"], result["iou_std"]["ceiling"] = _or_none(mean), _or_none(std)
        low, high = axis.edges[[0, -1]].tolist()
        result["axis"] = {"low": low, "high": high, "bins": axis.size}
    return result


def _add_method(
    result: Comparison,
    method: str,
    data: Values,
    values: Values,
    axis: hist.axis.Regular | None,
    draws: Draws,
) -> None:
    """Fill in the numbers of one method."""
    w1_error, ks_error = distance_errors(data, values, draws)
    result["wasserstein"][method] = _or_none(wasserstein(data, values))
    result["wasserstein_std"][method] = _or_none(w1_error)
    result["ks"][method] = _or_none(kolmogorov_smirnov(data, values))
    result["ks_std"][method] = _or_none(ks_error)
    result["missing"][method] = int(np.isnan(values).sum())
    if axis is not None:
        result["iou"][method] = _or_none(iou(data, values, axis))
        result["iou_std"][method] = _or_none(iou_error(data, values, axis, draws))


def _overlap(a: npt.NDArray[np.floating], b: npt.NDArray[np.floating]) -> Values:
    """IoU in percent of histograms along the first axis; NaN where one is empty."""
    with np.errstate(invalid="ignore"):
        a, b = (h / h.sum(axis=0, dtype=float) for h in (a, b))
        return np.asarray(100 * np.minimum(a, b).sum(axis=0) / np.maximum(a, b).sum(axis=0))


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
