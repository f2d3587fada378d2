"""Overlap and distance of two distributions of a parameter, and their values by chance.

The intersection over union (IoU) of two finite samples of the *same* distribution is
less than 100 %.  Each score therefore comes with its ceiling: the IoU of the measured
data with itself, resampled at the sizes of both datasets.

The Wasserstein-1 distance (W1) of two finite samples of the *same* distribution is not zero.
It therefore comes with its null: the distance of two samples drawn from the data themselves.

Distances between the datasets are exact.  Those of their bootstraps are computed together
on a common grid, the quantiles of the pooled values, with each of the outermost values in
a bin of its own.  The events of a bin are placed at its mean.  With 256 bins and thousands of
events, W1 is accurate to a twentieth of its null.  Datasets with fewer values than bins are
treated exactly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from hist.axis import Regular
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from cpunet.pulses.parameters import Values
from cpunet.pulses.shape_parameters import data_axis
from cpunet.recipes.schema import ScoreConfig

NODES = 256  # bins for bootstrapped errors; a finer grid gives the same spread
NULL_NODES = 4096  # and for a null, whose mean is compared with exact values
Histogram = npt.NDArray[np.floating]

# Above this number of events, bin counts are drawn directly, in a time independent of the
# number of events; below it, sums over drawn events are up to ten times faster.
MAX_EVENTS = 16_384

# Bins of a test of two samples, and events of the smaller one expected in each.
TEST_BINS, EXPECTED = 16, 15


Number = Annotated[  # None if it does not exist
    float | None,
    BeforeValidator(lambda v: None if v is None or not math.isfinite(v) else float(v)),
]
ByMethod = Mapping[str, Number]


class Result(BaseModel):
    """What ``metrics.json`` has; a field that is not set is not written."""

    model_config = ConfigDict(
        validate_assignment=True, validate_by_name=True, validate_by_alias=True
    )


class Missing(Result):
    """Reason why something is not scored."""

    missing: str


class Binning(Result):
    """Range and number of bins, None if the data have no finite value."""

    low: Number = None
    high: Number = None
    bins: int | None = None


class Compared(Result):
    """Comparison of one parameter of the data with that of every method.

    Attributes
    ----------
    iou, iou_std
        IoU and its error in percent, by method and for the ``ceiling``.  The ceiling is
        computed for the largest of the simulated datasets.
    wasserstein, wasserstein_std
        W1 of the finite values and its spread over bootstraps of both datasets, by method, in
        the parameter's unit.
    wasserstein_null, wasserstein_null_std
        Mean and spread of W1 of two samples of the data's own distribution, at the sizes of
        the data and of the largest of the simulated datasets.
    mean, shift, shift_std
        Mean of the data within the bins; that of a method minus that of the data, and its
        error.
    chi_square, degrees, p
        By method, see `two_sample_test`.
    missing
        Number of NaN values, by method and for the ``data``.
    axis
        Binning.
    """

    iou: ByMethod = Field(default_factory=dict)
    iou_std: ByMethod = Field(default_factory=dict)
    wasserstein: ByMethod = Field(default_factory=dict)
    wasserstein_std: ByMethod = Field(default_factory=dict)
    wasserstein_null: Number = None
    wasserstein_null_std: Number = None
    mean: Number = None
    shift: ByMethod = Field(default_factory=dict)
    shift_std: ByMethod = Field(default_factory=dict)
    chi_square: ByMethod = Field(default_factory=dict)
    degrees: dict[str, int] = Field(default_factory=dict)
    p: ByMethod = Field(default_factory=dict)
    missing: dict[str, int] = Field(default_factory=dict)
    axis: Binning = Binning()


class Resampled:
    """Bootstrap samples of a dataset, drawn with replacement.

    Parameters
    ----------
    events, size
        Number of events of the dataset, and of each sample.
    draws
        Number of samples.
    rng
        Random generator.

    Attributes
    ----------
    weights
        Multiplicity of each event in each sample, shape ``(events, draws)``; None for a large
        dataset, whose bin counts are drawn anew each time.
    """

    weights: npt.NDArray[np.float32] | None = None

    def __init__(self, events: int, size: int, draws: int, rng: np.random.Generator) -> None:
        self.events, self.size, self.draws, self.rng = events, size, draws, rng
        if events and max(events, size) <= MAX_EVENTS:
            drawn = rng.integers(events, size=(size, draws), dtype=np.int32)
            drawn *= draws
            drawn += np.arange(draws, dtype=np.int32)
            counts = np.bincount(drawn.ravel(), minlength=events * draws)
            self.weights = counts.astype(np.float32).reshape(events, draws)

    def counts(self, bins: npt.NDArray[np.integer], n_bins: int) -> npt.NDArray[np.float32]:
        """Histograms of the samples.

        Parameters
        ----------
        bins
            Bin of each event; events beyond the last bin are not counted.
        n_bins
            Number of bins.

        Returns
        -------
        numpy.ndarray
            Counts, float32, shape ``(n_bins, draws)``; all 0 if the dataset is empty.
        """
        from scipy.sparse import csc_array

        if not self.events:
            return np.zeros((n_bins, self.draws), np.float32)
        if self.weights is None:
            shares = np.bincount(bins, minlength=n_bins + 1) / self.events
            drawn = self.rng.multinomial(self.size, shares, size=self.draws)
            return np.ascontiguousarray(drawn[:, :n_bins].T, np.float32)
        ones = np.ones(self.events, np.float32)
        one_bin_each = (ones, bins.astype(np.int32), np.arange(self.events + 1, dtype=np.int32))
        summed = csc_array(one_bin_each, shape=(n_bins + 1, self.events)) @ self.weights
        return np.asarray(summed[:n_bins])


def finite_values(values: Values) -> Values:
    """Those values that are neither NaN nor infinite."""
    return values[np.isfinite(values)]


def wasserstein(a: Values, b: Values) -> float:
    r"""Wasserstein-1 distance of the finite values, in the unit of the parameter.

    .. math:: W_1 = \int |F_a(x) - F_b(x)| \, dx

    with the cumulative distributions :math:`F`.

    Parameters
    ----------
    a, b
        Values of one parameter in both datasets.

    Returns
    -------
    float
        Distance; NaN if a dataset has no finite values.

    Examples
    --------
    The distance between shifted copies is the shift:

    >>> import numpy as np
    >>> values = np.array([0.0, 1.0, 5.0])
    >>> wasserstein(values, values + 2)
    2.0
    """
    from scipy.stats import wasserstein_distance

    a, b = finite_values(a), finite_values(b)
    return float(wasserstein_distance(a, b)) if a.size and b.size else float("nan")


def drawn_distances(a: Values, b: Values, draws: Sequence[Resampled], nodes: int) -> Values:
    r"""W1 of pairs of bootstraps, in the parameter's unit; NaN without finite values of both.

    Of draws of both datasets the spread is the error of their distance.  Well above the null it
    agrees with the scatter of independent samples within a tenth; near the null it is a fifth
    too large, since a bootstrap adds its own scatter.

    The null, the distance of a perfect translation, is that of the data with themselves:

    .. math:: \langle W_1(D^*_{\mathrm{sim}}, D^*_{\mathrm{data}}) \rangle

    with two samples :math:`D^*` of the data in each draw, of the sizes of both datasets.  It
    scatters with an upward tail: 4 … 7 % of the draws are more than two standard deviations
    above the mean.

    Parameters
    ----------
    a, b
        Values of both datasets, of a null twice the data; others than finite ones are drawn
        but ignored.
    draws
        Bootstraps of both.
    nodes
        Maximum number of bins of the common grid.

    Examples
    --------
    Equal values have no distance:

    >>> import numpy as np
    >>> rng, same = np.random.default_rng(1), np.ones(50)
    >>> draws = Resampled(50, 50, 3, rng), Resampled(50, 20, 3, rng)
    >>> drawn_distances(same, same, draws, NULL_NODES)
    array([0., 0., 0.])
    """
    pooled = np.sort(finite_values(a if a is b else np.concatenate([a, b])))
    if not pooled.size:
        return np.full(1, np.nan)
    # a few outliers can dominate W1: the outermost values have bins of their own
    n, tail = len(pooled), nodes // 8
    edges = pooled
    if n > nodes:
        bulk = np.linspace(tail, n - 1 - tail, nodes - 2 * tail).round().astype(int)
        edges = pooled[np.r_[0:tail, bulk, n - tail : n]]
    upper = np.unique(edges)
    starts = np.r_[0, np.searchsorted(pooled, upper[:-1], side="right")]
    positions = np.add.reduceat(pooled, starts) / np.diff(np.r_[starts, n])
    below = []
    for values, drawn in zip((a, b), draws, strict=True):
        # values that are not finite are beyond the last bin
        bins = np.where(np.isfinite(values), np.searchsorted(upper, values), len(upper))
        # float32 represents whole numbers and their sums exactly below 2^24
        below.append(np.cumsum(drawn.counts(bins, len(upper)), axis=0))
    filled = (below[0][-1] > 0) & (below[1][-1] > 0)
    if not filled.any():
        return np.full(1, np.nan)
    first, second = (c[:-1, filled] / c[-1, filled].astype(float) for c in below)
    heights = np.abs(np.subtract(first, second, out=first), out=first)
    return np.asarray(np.diff(positions) @ heights)


def histogram(values: Values, axis: Regular, drawn: Resampled | None = None) -> Histogram:
    """Counts of all values: underflow, the bins, overflow, and the NaNs last.

    Parameters
    ----------
    values
        Values of one parameter.
    axis
        Binning, see `data_axis`.
    drawn
        Bootstraps whose counts are returned, a column each; by default those of the values.

    Examples
    --------
    >>> import numpy as np
    >>> axis = Regular(2, 0, 2)
    >>> histogram(np.array([-1, 0.5, 1.5, 1.6, np.inf, np.nan]), axis)
    array([1., 1., 2., 1., 1.])
    """
    places = np.asarray(axis.index(values)) + 1  # type: ignore[arg-type]  # arrays, too
    places = np.where(np.isnan(values), axis.size + 2, places)
    if drawn is not None:
        return drawn.counts(places, axis.size + 3)
    return np.bincount(places, minlength=axis.size + 3).astype(float)


def overlap(a: Histogram, b: Histogram) -> Values:
    r"""Intersection over union of two distributions, in percent (paper, section 4.3).

    .. math:: \mathrm{IoU} = \frac{\sum_i \min(a_i, b_i)}{\sum_i \max(a_i, b_i)}

    over the bins :math:`i` of two histograms (the Jaccard index).  Both histograms sum to
    one, including underflow, overflow and NaNs.  Near the ceiling the spread over bootstraps
    of both datasets is a sixth larger than the scatter of independent samples.

    Parameters
    ----------
    a, b
        Histograms of one parameter in both datasets, or columns of them, see `histogram`.

    Returns
    -------
    numpy.ndarray
        0 … 100, of each column; NaN if one of the histograms is empty.

    Examples
    --------
    >>> import numpy as np
    >>> overlap(np.array([1.0, 1.0, 0.0]), np.array([1.0, 0.0, 1.0])).round(3)
    np.float64(33.333)
    """
    with np.errstate(invalid="ignore"):
        a, b = (h / h.sum(axis=0, dtype=float) for h in (a, b))
        return np.asarray(100 * np.minimum(a, b).sum(axis=0) / np.maximum(a, b).sum(axis=0))


def two_sample_test(
    a: Values, b: Values, moved: Values | None = None
) -> tuple[float, int, float]:
    r"""Whether two samples are of one distribution, but for the errors of a fit.

    .. math:: \chi^2 = d^T \left[ \left(\tfrac{1}{n} + \tfrac{1}{m}\right)
        \left(\mathrm{diag}(q) - q q^T\right) + \sum_k \delta_k \delta_k^T \right]^{-1} d

    with the difference :math:`d` of the shares in bins of equal numbers of events of both
    samples together, their common shares :math:`q`, and the change :math:`\delta_k` of the
    shares with one standard deviation along each axis of the errors of the fit.  Undefined
    values are a bin of their own, or with the last one if they are few.

    Parameters
    ----------
    a, b
        Values of one parameter in both samples.
    moved
        Values of pulses of `b` at both ends of each axis, shape ``(axes, 2, pulses)``.

    Returns
    -------
    chi_square, degrees, p
        Chi-square, its degrees of freedom, and the probability of more.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> a, b = rng.normal(size=500), rng.normal(size=400)
    >>> two_sample_test(a, b)[2] > 0.05, two_sample_test(a, b + 0.5)[2] < 1e-4
    (True, True)
    """
    from scipy.stats import chi2

    pooled = np.concatenate([a, b])
    finite = np.sort(finite_values(pooled))
    least = min(len(a), len(b))
    if least < 2 * EXPECTED or not finite.size:
        return np.nan, 0, np.nan
    n_bins = min(TEST_BINS, least // EXPECTED)
    edges = np.unique(np.quantile(finite, np.linspace(0, 1, n_bins + 1)[1:-1]))
    nan_bin = np.isnan(pooled).sum() * least / len(pooled) >= EXPECTED

    def shares(values: Values) -> Values:
        last = len(edges) + 1 if nan_bin else len(edges)
        place = np.where(np.isnan(values), last, np.searchsorted(edges, values, side="right"))
        return np.bincount(place, minlength=len(edges) + 1 + nan_bin) / len(values)

    common = shares(pooled)
    covariance = (np.diag(common) - np.outer(common, common)) * (1 / len(a) + 1 / len(b))
    for low, high in () if moved is None else moved:
        change = 0.5 * (shares(low) - shares(high))
        covariance += np.outer(change, change)
    usable = np.flatnonzero(common)[1:]  # shares sum to 1
    if not usable.size:
        return 0.0, 0, 1.0
    apart_by = (shares(a) - shares(b))[usable]
    size = float(apart_by @ np.linalg.solve(covariance[np.ix_(usable, usable)], apart_by))
    return size, usable.size, float(chi2.sf(size, usable.size))


def shift(a: Values, b: Values, moved: Values | None = None) -> tuple[float, float]:
    """Mean of `b` minus that of `a`, and its error with those of a fit.

    Values beyond the ranges of both (`data_axis`) count as their ends, so that few outliers
    do not decide.
    """
    one, other = finite_values(a), finite_values(b)
    if min(len(one), len(other)) < 2:
        return np.nan, np.nan
    ends = np.array([data_axis(values, 1).edges for values in (one, other)])
    low, high = ends.min(), ends.max()
    one, other = one.clip(low, high), other.clip(low, high)
    variance = sum(values.var(ddof=1) / len(values) for values in (one, other))
    if moved is not None:
        usable = np.isfinite(moved).all(axis=(0, 1))
        means = moved[:, :, usable].clip(low, high).mean(axis=2)
        variance += (0.25 * (means[:, 0] - means[:, 1]) ** 2).sum()
    return float(other.mean() - one.mean()), float(np.sqrt(variance))


def compare(
    data: Mapping[str, Values],
    methods: Mapping[str, Mapping[str, Values]],
    scores: ScoreConfig,
    seed: int,
    moved: Mapping[str, Mapping[str, Values]] = MappingProxyType({}),
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
    moved
        Values by method and parameter at both ends of each axis of the errors of its fit,
        see `two_sample_test`.
    """
    # all parameters and methods share the same draws of data events
    rng, n_data = np.random.default_rng(seed), len(next(iter(data.values())))
    sizes = {m: len(next(iter(values.values()))) for m, values in methods.items()}
    n_sim = max(sizes.values(), default=0)
    null = [Resampled(n_data, n, scores.bootstraps, rng) for n in (n_sim, n_data)]
    axes: dict[str, Regular | None] = {}
    results: dict[str, dict[str, Any]] = {}
    for name, values in data.items():
        distances = drawn_distances(values, values, null, NULL_NODES)
        result = results[name] = {"missing": {"data": int(np.isnan(values).sum())}}
        result["wasserstein_null"] = distances.mean()
        result["wasserstein_null_std"] = distances.std()
        ceilings, finite, axis = np.full(1, np.nan), finite_values(values), None
        if finite.size:
            axis = data_axis(values, scores.max_bins)
            ceilings = overlap(*(histogram(values, axis, of) for of in null))
            low, high = axis.edges[[0, -1]].tolist()
            result["mean"] = finite.clip(low, high).mean()
            result["axis"] = Binning(low=low, high=high, bins=axis.size)
        axes[name] = axis
        result |= {"iou": {"ceiling": ceilings.mean()}, "iou_std": {"ceiling": ceilings.std()}}
    own = null[1]
    del null
    for method, by_name in methods.items():
        draws = [own, Resampled(sizes[method], sizes[method], scores.bootstraps, rng)]
        for name, result in results.items():
            both, axis = (data[name], by_name[name]), axes[name]
            ends = moved.get(method, {}).get(name)
            chi_square, degrees, p = two_sample_test(*both, ends)
            of_method: dict[str, Any] = {"chi_square": chi_square, "degrees": degrees, "p": p}
            of_method["shift"], of_method["shift_std"] = shift(*both, ends)
            of_method["wasserstein"] = wasserstein(*both)
            of_method["wasserstein_std"] = drawn_distances(*both, draws, NODES).std()
            of_method["missing"] = int(np.isnan(by_name[name]).sum())
            of_method["iou"] = of_method["iou_std"] = np.nan
            if axis is not None:
                drawn = (histogram(v, axis, of) for v, of in zip(both, draws, strict=True))
                of_method["iou"] = overlap(*(histogram(v, axis) for v in both))
                of_method["iou_std"] = overlap(*drawn).std()
            for key, value in of_method.items():
                result.setdefault(key, {})[method] = value
    return {name: Compared(**result) for name, result in results.items()}
