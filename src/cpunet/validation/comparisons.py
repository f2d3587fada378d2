"""Overlap of two distributions of a parameter, and the highest overlap to expect.

The intersection over union (IoU) of two finite samples of the *same* distribution is
less than 100 %.  Each score therefore comes with its ceiling: the IoU of the measured
data with itself, resampled at the sizes of both datasets.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypedDict

import hist
import numpy as np
import numpy.typing as npt

from cpunet.pulses.shape_parameters import data_axis
from cpunet.recipes.schema import ScoreConfig
from cpunet.validation.distances import (
    Bins,
    Draws,
    Resampled,
    distance_errors,
    kolmogorov_smirnov,
    null_distances,
    resampled_twice,
    wasserstein,
)

Values = npt.NDArray[np.float64]
ByMethod = dict[str, float | None]


class Compared(TypedDict):
    """Result of `compare` for one parameter."""

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


def histogram(values: Values, axis: hist.axis.Regular) -> Values:
    """Counts of all values: underflow, the bins, overflow, and the NaNs last.

    Parameters
    ----------
    values
        Values of one parameter.
    axis
        Binning, see `data_axis`.

    Examples
    --------
    >>> import numpy as np
    >>> axis = hist.axis.Regular(2, 0, 2)
    >>> histogram(np.array([-1, 0.5, 1.5, 1.6, np.inf, np.nan]), axis)
    array([1., 1., 2., 1., 1.])
    """
    missing = np.isnan(values)
    # boost-histogram would count NaNs in the overflow bin
    counts = hist.Hist(axis).fill(values[~missing]).values(flow=True)
    return np.append(counts, float(missing.sum()))


def iou(a: Values, b: Values, axis: hist.axis.Regular) -> float:
    r"""Intersection over union of two distributions, in percent (paper, section 4.3).

    .. math:: \mathrm{IoU} = \frac{\sum_i \min(a_i, b_i)}{\sum_i \max(a_i, b_i)}

    over the bins :math:`i` of two histograms (the Jaccard index).  Both histograms sum to
    one, including underflow, overflow and NaNs.

    Parameters
    ----------
    a, b
        Values of one parameter in both datasets.
    axis
        Common binning, see `data_axis`.

    Returns
    -------
    float
        0 … 100; NaN if one of the datasets is empty.

    Examples
    --------
    >>> import numpy as np
    >>> axis = hist.axis.Regular(2, 0, 2)
    >>> round(iou(np.array([0.5, 1.5]), np.array([0.5, 7.0]), axis), 3)
    33.333
    """
    return float(_overlap(histogram(a, axis), histogram(b, axis)))


def ceiling(data: Values, axis: hist.axis.Regular, draws: Draws) -> tuple[float, float]:
    r"""IoU of the data with itself: the score of a perfect translation.

    .. math:: C = \langle \mathrm{IoU}(D^*_{\mathrm{sim}}, D^*_{\mathrm{data}}) \rangle

    In each draw, two samples :math:`D^*` are drawn from the data with replacement, one of
    the size of the simulated dataset and one of the size of the measured one.

    Parameters
    ----------
    data
        Measured values of one parameter.
    axis
        Common binning, see `data_axis`.
    draws
        Bootstraps of the data, see `cpunet.validation.distances.resampled_twice`.

    Returns
    -------
    tuple of float
        Mean and standard deviation of the IoU in percent over the draws.

    Examples
    --------
    With all data in one bin nothing scatters:

    >>> import numpy as np
    >>> from cpunet.validation.distances import resampled_twice
    >>> draws = resampled_twice(50, n_sim=50, n_data=20, draws=8, seed=1)
    >>> ceiling(np.full(50, 0.5), hist.axis.Regular(2, 0, 2), draws)
    (100.0, 0.0)
    """
    bins, n_bins = _bins(data, axis)
    scores = _overlap(*(of_set.counts(bins, n_bins) for of_set in draws))
    return float(scores.mean()), float(scores.std())


def iou_error(a: Values, b: Values, axis: hist.axis.Regular, draws: Draws) -> float:
    """Standard deviation of `iou`, in percent, under resampling of both datasets.

    Near the ceiling it is a sixth larger than the scatter of independent samples.

    Parameters
    ----------
    a, b
        Values of one parameter in both datasets.
    axis
        Common binning, see `data_axis`.
    draws
        Bootstraps of both, each of its own size.
    """
    drawn = (d.counts(*_bins(v, axis)) for v, d in zip((a, b), draws, strict=True))
    return float(_overlap(*drawn).std())


def _bins(values: Values, axis: hist.axis.Regular) -> tuple[Bins, int]:
    """Bin of each value in `histogram`, and the number of bins."""
    places = np.asarray(axis.index(values)) + 1  # type: ignore[arg-type]  # arrays, too
    return np.where(np.isnan(values), axis.size + 2, places), axis.size + 3


def compare(
    data: Mapping[str, Values],
    methods: Mapping[str, Mapping[str, Values]],
    scores: ScoreConfig,
    seed: int,
) -> dict[str, Compared]:
    """Compare each parameter of the data with that of every method.

    Parameters
    ----------
    data
        Measured values by parameter, see `parameters.pulse_parameters`.
    methods
        Values by method and parameter: ``{"raw": …, "ren": …}`` and any others.
    scores
        Score settings: numbers of bins and of bootstraps.
    seed
        Seed of the bootstraps.

    Returns
    -------
    dict
        For each parameter, JSON-ready (``None`` where a number does not exist):

        ``iou``, ``iou_std``
            IoU and its error in percent, by method and for the ``ceiling``.  The ceiling
            is computed for the largest of the simulated datasets.
        ``wasserstein``, ``ks``, ``wasserstein_std``, ``ks_std``
            distances of the finite values and their errors, by method; in the parameter's
            unit, and 0 … 1.  The errors are spreads over bootstraps of both datasets.
        ``wasserstein_null``, ``ks_null``, ``wasserstein_null_std``, ``ks_null_std``
            mean and spread of the distances of two samples of the data's own distribution,
            at the sizes of the data and of the largest of the simulated datasets.
        ``missing``
            number of NaN values, by method and for the ``data``.
        ``axis``
            ``low``, ``high`` and ``bins`` of the binning.
    """
    # all parameters and methods share the same draws of data events
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
) -> Compared:
    """Ceiling and nulls from the data alone, before any method is added."""
    distances = null_distances(data, null)
    result = Compared(
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
    result: Compared,
    method: str,
    data: Values,
    values: Values,
    axis: hist.axis.Regular | None,
    draws: Draws,
) -> None:
    """Add the scores of one method."""
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
