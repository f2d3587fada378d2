"""Bootstraps: histograms of many samples of a dataset, and their quantiles.

All parameters of the same events are counted with the same draws.  A quantile needs none.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cpunet.pulses.parameters import Values

Counts = npt.NDArray[np.float32]
Bins = npt.NDArray[np.integer]

# Above this number of events, bin counts are drawn directly, in a time independent of the
# number of events; below it, sums over drawn events are up to ten times faster.
MAX_EVENTS = 16_384


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

    weights: Counts | None = None

    def __init__(self, events: int, size: int, draws: int, rng: np.random.Generator) -> None:
        self.events, self.size, self.draws, self.rng = events, size, draws, rng
        if events and max(events, size) <= MAX_EVENTS:
            drawn = rng.integers(events, size=(size, draws), dtype=np.int32)
            drawn *= draws
            drawn += np.arange(draws, dtype=np.int32)
            counts = np.bincount(drawn.ravel(), minlength=events * draws)
            self.weights = counts.astype(np.float32).reshape(events, draws)

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


def resampled_quantiles(
    values: Values, quantile: float, draws: int, rng: np.random.Generator
) -> Values:
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
