r"""Weights of many functions from the same pulses as their means, and the resulting bias.

Parameters are determined by the agreement of weighted means of many functions on both sides,
see `cpunet.training.optimal_weights`.  Weights and means come from the same pulses and are not
independent: a bin that by chance holds few pulses has a small covariance and small derivatives.
With many functions the parameters are therefore biased, by an amount that scales as one over
the number of pulses (Newey and Smith, Econometrica 72 (2004) 219).  Leaving out pulses
estimates such a bias (the jackknife; Quenouille, Biometrika 43 (1956) 353),

.. math:: b = (K - 1) \left(\frac{1}{K} \sum_k \hat\theta_{-k} - \hat\theta\right),

where the k-th of K parts of both sides is left out of weights and means.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from cpunet.training.moments import Values

RIDGE = 0.05  # share of a diagonal matrix in the correlations of the functions


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over pulses, which can be added.

    Parameters
    ----------
    n
        Sum of the weights of the pulses.
    total
        Sum of the functions, shape (functions,).
    products
        Sum of products of two functions, shape (functions, functions).
    moved
        Sum of the derivatives of the functions, shape (functions, coordinates).
    """

    n: float = 0.0
    total: Values | float = 0.0
    products: Values | float = 0.0
    moved: Values | float = 0.0

    @classmethod
    def of(cls, values: Values) -> Sums:
        """Sums over measured pulses, which have no derivatives.

        Parameters
        ----------
        values
            Functions of each, shape (pulses, functions).
        """
        return cls(len(values), values.sum(axis=0), values.T @ values)

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.n + other.n,
            self.total + other.total,
            self.products + other.products,
            self.moved + other.moved,
        )

    @property
    def mean(self) -> Values:
        """Mean of the functions."""
        return np.asarray(self.total / self.n)

    @property
    def covariance(self) -> Values:
        """Covariance of the functions."""
        return np.asarray(self.products / self.n - np.outer(self.mean, self.mean))


class WeightedMeans:
    """Weights from sums over both sides, and the weighted means of the same sums.

    Parameters
    ----------
    simulated, measured
        Sums over the two sides.
    pairs
        Number of pulses that errors refer to.
    ridge
        Share of a diagonal matrix in the correlations of the weighted means, for coordinates
        whose means may be alike.

    Attributes
    ----------
    weights
        Shape (functions, coordinates).
    whiten
        Makes the weighted means uncorrelated, in units of their errors.
    deviations, slopes
        Whitened differences of the two sides, and their derivatives in the coordinates.
    """

    def __init__(
        self, simulated: Sums, measured: Sums, pairs: float, ridge: float = 0.0
    ) -> None:
        slopes = np.asarray(simulated.moved / simulated.n)
        covariance = 0.5 * (simulated.covariance + measured.covariance)
        sigma = np.maximum(np.sqrt(covariance.diagonal()), 1e-12)[:, np.newaxis]
        correlation = (1 - RIDGE) * covariance / sigma / sigma.T + RIDGE * np.eye(len(sigma))
        self.weights: Values = np.linalg.solve(correlation, slopes / sigma) / sigma
        spread = self.weights.T @ measured.covariance @ self.weights / pairs
        if ridge:
            spread += ridge * np.diag(spread.diagonal())
        self.whiten = np.asarray(scipy.linalg.cholesky(np.linalg.inv(spread)))
        weighing = self.whiten @ self.weights.T
        self.slopes = weighing @ slopes
        self.deviations = weighing @ (simulated.mean - measured.mean)


class Parts:
    """Weighted means of all pulses, and of all but one part of them.

    Parameters
    ----------
    simulated, measured
        Sums over each part of the two sides, with the same number of parts.
    pairs, ridge
        As of `WeightedMeans`.
    """

    def __init__(
        self,
        simulated: Sequence[Sums],
        measured: Sequence[Sums],
        pairs: float,
        ridge: float = 0.0,
    ) -> None:
        def of(left_out: int | None, share: float) -> WeightedMeans:
            sides = [
                sum((sums for k, sums in enumerate(side) if k != left_out), Sums())
                for side in (simulated, measured)
            ]
            return WeightedMeans(sides[0], sides[1], share * pairs, ridge)

        parts = len(measured)
        self.whole = of(None, 1.0)
        self.without = [of(part, 1 - 1 / parts) for part in range(parts)]


def jackknife_bias(
    bands: Sequence[Parts], prior: Values, widths: Values, held: Values
) -> Values:
    """Bias of the coordinates at which the weighted means agree, to first order.

    Parameters
    ----------
    bands
        Bands compared together, with the same number of parts.
    prior, widths
        Deviations of the coordinates from their priors in units of the widths, and the widths.
    held
        Moves of the coordinates that are held, for example at a bound; NaN for free ones.

    Returns
    -------
    array
        Bias to be subtracted, shape (coordinates,).
    """
    free, scale = np.isnan(held), np.diag(1 / widths)

    def move(compared: Sequence[WeightedMeans]) -> Values:
        columns = np.concatenate([*(means.slopes for means in compared), scale])
        left = np.concatenate([*(means.deviations for means in compared), prior])
        left = left + columns @ np.where(free, 0.0, held)
        moved = np.zeros(len(held))
        moved[free] = -np.linalg.lstsq(columns[:, free], left)[0]
        return moved

    whole = move([band.whole for band in bands])
    rest = [move(means) for means in zip(*(band.without for band in bands), strict=True)]
    return np.asarray((len(rest) - 1) * (np.mean(rest, axis=0) - whole))
