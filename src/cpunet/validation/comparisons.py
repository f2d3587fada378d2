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
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple, Self

import hist
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from cpunet.pulses.shape_parameters import data_axis
from cpunet.recipes.schema import ScoreConfig

Values = npt.NDArray[np.float64]

NODES = 256  # bins for bootstrapped errors; a finer grid gives the same spread
NULL_NODES = 4096  # and for a null, whose mean is compared with exact values
Counts = npt.NDArray[np.float32]
Bins = npt.NDArray[np.integer]
Draws = tuple["Resampled", "Resampled"]  # of the two datasets that are compared

# Bins of a test of two samples, and events of the smaller one expected in each.
TEST_BINS, EXPECTED = 16, 15

# Above this number of events, bin counts are drawn directly, in a time independent of the
# number of events; below it, sums over drawn events are up to ten times faster.
MAX_EVENTS = 16_384


def _number(value: Any) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


Number = Annotated[float | None, BeforeValidator(_number)]  # None if it does not exist
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


@dataclass(frozen=True, eq=False)
class Resampled:
    """Bootstrap samples of a dataset.

    Parameters
    ----------
    events, size
        Number of events of the dataset, and of each sample.
    draws
        Number of samples.
    rng
        Random generator of bin counts that are drawn later.
    weights
        Multiplicity of each event in each sample, shape ``(events, draws)``; None for a large
        dataset, whose bin counts are drawn anew each time.
    """

    events: int
    size: int
    draws: int
    rng: np.random.Generator = field(repr=False)
    weights: Counts | None = field(repr=False)

    @classmethod
    def of(cls, events: int, size: int, draws: int, rng: np.random.Generator) -> Self:
        """Draw `size` of `events` events with replacement, `draws` times."""
        weights = None
        if 0 < max(events, size) <= MAX_EVENTS and events:
            drawn = rng.integers(events, size=(size, draws), dtype=np.int32)
            drawn *= draws
            drawn += np.arange(draws, dtype=np.int32)
            counts = np.bincount(drawn.ravel(), minlength=events * draws)
            weights = counts.astype(np.float32).reshape(events, draws)
        return cls(events, size, draws, rng, weights)

    def counts(self, bins: Bins, n_bins: int) -> Counts:
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


def resampled_twice(
    events: int, n_sim: int, n_data: int, draws: int, seed: int | np.random.Generator
) -> Draws:
    """Pairs of bootstraps of one dataset, of the simulated and of the measured size.

    Parameters
    ----------
    events
        Number of events of the dataset.
    n_sim, n_data
        Numbers of events of the two samples of a pair.
    draws
        Number of pairs.
    seed
        Seed or random generator.
    """
    rng = np.random.default_rng(seed)
    return Resampled.of(events, n_sim, draws, rng), Resampled.of(events, n_data, draws, rng)


def resampled_quantiles(
    values: npt.NDArray[np.float64], quantile: float, draws: int, rng: np.random.Generator
) -> npt.NDArray[np.float64]:
    r"""Quantiles (NumPy's ``"weibull"``) of bootstrap samples, without drawing the samples.

    The k-th smallest of n uniform numbers follows :math:`\mathrm{Beta}(k, n + 1 - k)`.  The
    k-th smallest value of a bootstrap sample is the data value at that rank.  The next
    order statistic follows from another beta variate.

    Parameters
    ----------
    values
        Data, shape ``(n,)``.
    quantile
        Quantile, 0 … 1.
    draws
        Number of bootstrap samples.
    rng
        Random generator.
    """
    ordered, n = np.sort(values), len(values)
    rank = quantile * (n + 1)  # counted from 1; usually between two values
    below = int(np.clip(np.floor(rank), 1, n))
    first = rng.beta(below, n + 1 - below, draws)
    lower = ordered[np.minimum((n * first).astype(int), n - 1)]
    if below == n or rank <= below:
        return np.asarray(lower)
    second = first + (1 - first) * rng.beta(1, n - below, draws)
    upper = ordered[np.minimum((n * second).astype(int), n - 1)]
    return np.asarray(lower + (rank - below) * (upper - lower))


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

    a, b = _finite(a), _finite(b)
    return float(wasserstein_distance(a, b)) if a.size and b.size else float("nan")


def wasserstein_error(a: Values, b: Values, draws: Draws) -> float:
    """Standard deviation of W1, in the parameter's unit, under resampling of both datasets.

    Well above the null it agrees with the scatter of independent samples within a tenth.
    Near the null it is a fifth too large, since a bootstrap adds its own scatter; there
    `null_wasserstein` gives the scale.

    Parameters
    ----------
    a, b
        Values of both datasets; non-finite ones are resampled but ignored.  Without finite
        ones of both there is no error: NaN.
    draws
        Bootstraps of both, each of its own size.
    """
    if not (np.isfinite(a).any() and np.isfinite(b).any()):
        return float("nan")
    grid = _grid(_finite(np.concatenate([a, b])), NODES)
    return float(_distances((a, b), draws, *grid).std())


def null_wasserstein(data: Values, draws: Draws) -> tuple[float, float]:
    r"""W1 of the data with themselves: the distance of a perfect translation, and its spread.

    .. math:: \langle W_1(D^*_{\mathrm{sim}}, D^*_{\mathrm{data}}) \rangle

    In each draw, two samples :math:`D^*` are drawn from the data with replacement, one of
    the size of the simulated dataset and one of the size of the measured one.  The distance
    scatters with an upward tail: 4 … 7 % of the draws are more than two standard deviations
    above the mean.

    Parameters
    ----------
    data
        Measured values; non-finite ones are drawn but ignored.
    draws
        Bootstraps of the data, see `resampled_twice`.

    Returns
    -------
    tuple of float
        NaN if the data have no finite values or a dataset is empty.

    Examples
    --------
    Equal values have no distance:

    >>> import numpy as np
    >>> draws = resampled_twice(50, n_sim=50, n_data=20, draws=8, seed=1)
    >>> null_wasserstein(np.ones(50), draws)
    (0.0, 0.0)
    """
    finite = _finite(data)
    if not (finite.size and all(d.size for d in draws)):
        return float("nan"), float("nan")
    w1 = _distances((data, data), draws, *_grid(finite, NULL_NODES))
    return float(w1.mean()), float(w1.std())


def _grid(pooled: Values, nodes: int) -> tuple[Values, Values]:
    """Upper edges of bins that contain every value, and the mean of the values in each.

    The outermost values have bins of their own: a few outliers can dominate W1.
    """
    pooled = np.sort(pooled)
    n, tail = len(pooled), nodes // 8
    if n > nodes:
        bulk = np.linspace(tail, n - 1 - tail, nodes - 2 * tail).round().astype(int)
        pooled_upper = pooled[np.r_[0:tail, bulk, n - tail : n]]
    else:
        pooled_upper = pooled
    upper = np.unique(pooled_upper)
    first = np.searchsorted(pooled, upper[:-1], side="right")
    starts = np.r_[0, first]
    return upper, np.add.reduceat(pooled, starts) / np.diff(np.r_[starts, n])


def _distances(
    values: tuple[Values, Values], draws: Draws, upper: Values, positions: Values
) -> Values:
    """W1 of each pair of draws, whose events are counted up to `upper`, at `positions`.

    Non-finite values are beyond the last bin; draws without others are left out.
    """
    below = []
    for of_set, resampled in zip(values, draws, strict=True):
        bins = np.where(np.isfinite(of_set), np.searchsorted(upper, of_set), len(upper))
        # float32 represents whole numbers and their sums exactly below 2^24
        below.append(np.cumsum(resampled.counts(bins, len(upper)), axis=0))
    drawn = (below[0][-1] > 0) & (below[1][-1] > 0)
    if not drawn.any():
        return np.full(1, np.nan)
    first, second = (c[:-1, drawn] / c[-1, drawn].astype(float) for c in below)
    heights = np.abs(np.subtract(first, second, out=first), out=first)
    return np.asarray(np.diff(positions) @ heights)


def _finite(values: Values) -> Values:
    return values[np.isfinite(values)]


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
    bins, n_bins = _axis_bins(values, axis)
    return np.bincount(bins, minlength=n_bins).astype(float)


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
        Bootstraps of the data, see `resampled_twice`.

    Returns
    -------
    tuple of float
        Mean and standard deviation of the IoU in percent over the draws.

    Examples
    --------
    With all data in one bin nothing scatters:

    >>> import numpy as np
    >>> draws = resampled_twice(50, n_sim=50, n_data=20, draws=8, seed=1)
    >>> ceiling(np.full(50, 0.5), hist.axis.Regular(2, 0, 2), draws)
    (100.0, 0.0)
    """
    bins, n_bins = _axis_bins(data, axis)
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
    drawn = (d.counts(*_axis_bins(v, axis)) for v, d in zip((a, b), draws, strict=True))
    return float(_overlap(*drawn).std())


def _axis_bins(values: Values, axis: hist.axis.Regular) -> tuple[Bins, int]:
    """Bin of each value in `histogram`, and the number of bins."""
    places = np.asarray(axis.index(values)) + 1  # type: ignore[arg-type]  # arrays, too
    return np.where(np.isnan(values), axis.size + 2, places), axis.size + 3


class Tested(NamedTuple):
    """Chi-square of two samples, its degrees of freedom, and the probability of more."""

    chi_square: float
    degrees: int
    p: float


def two_sample_test(a: Values, b: Values, moved: Values | None = None) -> Tested:
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

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> a, b = rng.normal(size=500), rng.normal(size=400)
    >>> two_sample_test(a, b).p > 0.05, two_sample_test(a, b + 0.5).p < 1e-4
    (True, True)
    """
    from scipy.stats import chi2

    pooled = np.concatenate([a, b])
    finite = np.sort(_finite(pooled))
    least = min(len(a), len(b))
    if least < 2 * EXPECTED or not finite.size:
        return Tested(np.nan, 0, np.nan)
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
        return Tested(0.0, 0, 1.0)
    apart_by = (shares(a) - shares(b))[usable]
    size = float(apart_by @ np.linalg.solve(covariance[np.ix_(usable, usable)], apart_by))
    return Tested(size, usable.size, float(chi2.sf(size, usable.size)))


def shift(a: Values, b: Values, moved: Values | None = None) -> tuple[float, float]:
    """Mean of `b` minus that of `a`, and its error with those of a fit.

    Values beyond the ranges of both (`data_axis`) count as their ends, so that few outliers
    do not decide.
    """
    one, other = _finite(a), _finite(b)
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
    null = resampled_twice(n_data, n_sim, n_data, scores.bootstraps, rng)
    present = {name: values for name, values in data.items() if np.isfinite(values).any()}
    axes = {name: data_axis(values, scores.max_bins) for name, values in present.items()}
    results: dict[str, dict[str, Any]] = {}
    for name, values in data.items():
        axis, (w1, spread) = axes.get(name), null_wasserstein(values, null)
        score, std = (np.nan, np.nan) if axis is None else ceiling(values, axis, null)
        results[name] = {
            "iou": {"ceiling": score},
            "iou_std": {"ceiling": std},
            "wasserstein_null": w1,
            "wasserstein_null_std": spread,
            "missing": {"data": int(np.isnan(values).sum())},
        }
        if axis is not None:
            low, high = axis.edges[[0, -1]].tolist()
            results[name]["mean"] = _finite(values).clip(low, high).mean()
            results[name]["axis"] = Binning(low=low, high=high, bins=axis.size)
    own = null[1]
    del null
    for method, by_name in methods.items():
        draws = (own, Resampled.of(sizes[method], sizes[method], scores.bootstraps, rng))
        for name, result in results.items():
            both, axis = (data[name], by_name[name]), axes.get(name)
            ends = moved.get(method, {}).get(name)
            tested, (difference, error) = two_sample_test(*both, ends), shift(*both, ends)
            of_method = tested._asdict() | {
                "wasserstein": wasserstein(*both),
                "wasserstein_std": wasserstein_error(*both, draws),
                "missing": int(np.isnan(by_name[name]).sum()),
                "iou": np.nan if axis is None else iou(*both, axis),
                "iou_std": np.nan if axis is None else iou_error(*both, axis, draws),
                "shift": difference,
                "shift_std": error,
            }
            for key, value in of_method.items():
                result.setdefault(key, {})[method] = value
    return {name: Compared(**result) for name, result in results.items()}


def _overlap(a: npt.NDArray[np.floating], b: npt.NDArray[np.floating]) -> Values:
    """IoU in percent of histograms along the first axis; NaN where one is empty."""
    with np.errstate(invalid="ignore"):
        a, b = (h / h.sum(axis=0, dtype=float) for h in (a, b))
        return np.asarray(100 * np.minimum(a, b).sum(axis=0) / np.maximum(a, b).sum(axis=0))
