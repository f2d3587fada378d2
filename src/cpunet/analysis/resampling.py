"""Bootstrap samples of events: drawn once, and counted in whatever bins are asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

Counts = npt.NDArray[np.float32]
Bins = npt.NDArray[np.integer]
Draws = tuple["Resampled", "Resampled"]  # of the two sets that are compared

# With more events than these the counts of the bins are drawn, which takes as long for any
# number of events; below, sums over the events drawn are faster by up to ten times.
MOST_EVENTS = 16_384


@dataclass(frozen=True, eq=False)
class Resampled:
    """Bootstrap samples of a set of events.

    Parameters
    ----------
    events, size
        Events of the set, and of each sample.
    draws
        Samples.
    rng
        Of what is drawn later.
    weights
        How often each event is in each sample, shape ``(events, draws)``; None for a large
        set, of whose bins the counts are drawn anew each time.
    """

    events: int
    size: int
    draws: int
    rng: np.random.Generator = field(repr=False)
    weights: Counts | None = field(repr=False)

    @classmethod
    def of(cls, events: int, size: int, draws: int, rng: np.random.Generator) -> Self:
        """Draw `size` of so many events with replacement, `draws` times."""
        weights = None
        if 0 < max(events, size) <= MOST_EVENTS and events:
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
            Bin of each event; an event beyond the last is counted in none.
        n_bins
            Number of the bins.

        Returns
        -------
        numpy.ndarray
            Shape ``(n_bins, draws)``, float32; all 0 if the set is empty.
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


def both_resampled(n_a: int, n_b: int, draws: int, seed: int | np.random.Generator) -> Draws:
    """Bootstraps of two sets, each at its own size."""
    rng = np.random.default_rng(seed)
    return Resampled.of(n_a, n_a, draws, rng), Resampled.of(n_b, n_b, draws, rng)


def resampled_twice(
    events: int, n_sim: int, n_data: int, draws: int, seed: int | np.random.Generator
) -> Draws:
    """Pairs of samples of one set, as large as the simulated and as the measured one."""
    rng = np.random.default_rng(seed)
    return Resampled.of(events, n_sim, draws, rng), Resampled.of(events, n_data, draws, rng)


def resampled_quantiles(
    values: npt.NDArray[np.float64], quantile: float, draws: int, rng: np.random.Generator
) -> npt.NDArray[np.float64]:
    """Quantiles (NumPy's ``"weibull"``) of bootstrap samples that are not drawn themselves.

    The k-th smallest of a sample is the value at the rank of the k-th smallest of as many
    uniform numbers, which is a beta variate, as is the smallest of those above it.
    """
    ordered, n = np.sort(values), len(values)
    rank = quantile * (n + 1)  # from 1; mostly between two values
    below = int(np.clip(np.floor(rank), 1, n))
    first = rng.beta(below, n + 1 - below, draws)
    lower = ordered[np.minimum((n * first).astype(int), n - 1)]
    if below == n or rank <= below:
        return np.asarray(lower)
    second = first + (1 - first) * rng.beta(1, n - below, draws)
    upper = ordered[np.minimum((n * second).astype(int), n - 1)]
    return np.asarray(lower + (rank - below) * (upper - lower))
