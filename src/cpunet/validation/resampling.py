"""Bootstrap samples of events: drawn once, and histogrammed in any binning."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

Counts = npt.NDArray[np.float32]
Bins = npt.NDArray[np.integer]
Draws = tuple["Resampled", "Resampled"]  # of the two datasets that are compared

# Above this number of events, bin counts are drawn directly, in a time independent of the
# number of events; below it, sums over drawn events are up to ten times faster.
MAX_EVENTS = 16_384


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
