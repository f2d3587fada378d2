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
    resampled,
    wasserstein,
)
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


def ceiling(
    data: Values,
    n_sim: int,
    n_data: int,
    axis: hist.axis.Regular,
    bootstraps: int,
    seed: int | np.random.Generator,
) -> tuple[float, float]:
    """IoU of the data with itself: what a perfect translation would score.

    Two sets are drawn from the data with replacement, one as large as the simulated
    set and one as large as the measured one, again and again.

    Returns
    -------
    tuple of float
        Mean and standard deviation of the IoU in percent over the `bootstraps` draws.
    """
    rng = np.random.default_rng(seed)
    counts = histogram(data, axis)
    scores = _overlap(*(resampled(counts, n, bootstraps, rng) for n in (n_sim, n_data)))
    return float(scores.mean()), float(scores.std())


def iou_error(
    a: Values,
    b: Values,
    axis: hist.axis.Regular,
    bootstraps: int,
    seed: int | np.random.Generator,
) -> float:
    """Standard deviation, in percent, of `iou` under resampling of both sets.

    Near the ceiling it is a sixth larger than the scatter of fresh samples.
    """
    rng = np.random.default_rng(seed)
    drawn = (resampled(histogram(v, axis), len(v), bootstraps, rng) for v in (a, b))
    return float(_overlap(*drawn).std())


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
    # each has its own, so that neither changes the other's numbers
    rng, distance_rng = (np.random.default_rng(s) for s in (seed, (seed, 1)))
    for method, values in methods.items():
        if absent := data.keys() - values.keys():
            raise CpunetError(f"{method}: parameter {min(absent)} is missing; compute it too")
    return {
        name: _compare_one(
            values, {m: p[name] for m, p in methods.items()}, scores, rng, distance_rng
        )
        for name, values in data.items()
    }


def _compare_one(
    data: Values,
    methods: Mapping[str, Values],
    scores: ScoreConfig,
    rng: np.random.Generator,
    distance_rng: np.random.Generator,
) -> Comparison:
    draws = scores.bootstraps
    errors = {m: distance_errors(data, v, draws, distance_rng) for m, v in methods.items()}
    n_sim = max((int(np.isfinite(v).sum()) for v in methods.values()), default=0)
    null = null_distances(data, n_sim, int(np.isfinite(data).sum()), draws, distance_rng)
    result = Comparison(
        iou=dict.fromkeys([*methods, "ceiling"]),
        iou_std=dict.fromkeys([*methods, "ceiling"]),
        wasserstein={m: _or_none(wasserstein(data, v)) for m, v in methods.items()},
        wasserstein_std={m: _or_none(w1) for m, (w1, _) in errors.items()},
        wasserstein_null=_or_none(null.wasserstein),
        wasserstein_null_std=_or_none(null.wasserstein_std),
        ks={m: _or_none(kolmogorov_smirnov(data, v)) for m, v in methods.items()},
        ks_std={m: _or_none(ks) for m, (_, ks) in errors.items()},
        ks_null=_or_none(null.ks),
        ks_null_std=_or_none(null.ks_std),
        missing={m: int(np.isnan(v).sum()) for m, v in {"data": data, **methods}.items()},
        axis=dict.fromkeys(("low", "high", "bins")),
    )
    if np.isfinite(data).any():
        _add_overlap(result, data, methods, scores, rng)
    return result


def _add_overlap(
    result: Comparison,
    data: Values,
    methods: Mapping[str, Values],
    scores: ScoreConfig,
    rng: np.random.Generator,
) -> None:
    """Fill in what depends on the binning."""
    axis = data_axis(data, scores.max_bins)
    for method, values in methods.items():
        result["iou"][method] = _or_none(iou(data, values, axis))
        result["iou_std"][method] = _or_none(
            iou_error(data, values, axis, scores.bootstraps, rng)
        )
    n_sim = max(map(len, methods.values()), default=0)
    mean, std = ceiling(data, n_sim, len(data), axis, scores.bootstraps, rng)
    result["iou"]["ceiling"], result["iou_std"]["ceiling"] = _or_none(mean), _or_none(std)
    low, high = axis.edges[[0, -1]].tolist()
    result["axis"] = {"low": low, "high": high, "bins": axis.size}


def _overlap(a: Values, b: Values) -> Values:
    """IoU in percent of histograms along the last axis; NaN where one is empty."""
    sums = [h.sum(axis=-1, keepdims=True) for h in (a, b)]
    with np.errstate(invalid="ignore"):
        a, b = a / sums[0], b / sums[1]
    return np.asarray(100 * np.minimum(a, b).sum(axis=-1) / np.maximum(a, b).sum(axis=-1))


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
