r"""Extract all information on a response from unpaired pulses by optimally weighted functions.

The chi-square of a fit compares about eighty means, each over all pulses.  But the effect of
the bandwidth on the edge is largest in single-site pulses, which have the highest current
amplitude, and hardly visible in the others.  Each principal component is therefore also taken
in bins of the current amplitude.  This gives about five hundred functions :math:`\varphi`, too
many to compare one by one.  To first order, only as many of their linear combinations depend
on the parameters as there are parameters,

.. math:: t(x) = J^T C^{-1} \varphi(x), \qquad J = \partial\langle\varphi\rangle/\partial\theta,

with the covariance C of the functions: the efficient weights of the generalised method of
moments (Hansen, Econometrica 50 (1982) 1029), and Fisher's linear discriminant between
neighbouring responses.  J comes from the simulation translated by a fitted response, C from
both sides; the parameters are those at which the means of t agree.

Weights and means come from the same pulses and are not independent: a bin that by chance holds
few pulses has a small covariance and small derivatives.  With so many functions the parameters
are therefore biased, by an amount that scales as one over the number of pulses (Newey and
Smith, Econometrica 72 (2004) 219).  Leaving out pulses estimates such a bias (the jackknife;
Quenouille, Biometrika 43 (1956) 353), which is subtracted,

.. math:: b = (K - 1) \left(\frac{1}{K} \sum_k \hat\theta_{-k} - \hat\theta\right),

where the k-th of K parts of both sides is left out of weights and means.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import add
from typing import NamedTuple

import numpy as np
import scipy.linalg

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import FloatArray
from cpunet.training.differentiable import DifferentiableSet
from cpunet.training.levenberg_marquardt import AT_BOUND, descend
from cpunet.training.moments import (
    BLOCK,
    Moments,
    Readings,
    Values,
    gaussian_bins,
    joined,
    products,
    spread,
)
from cpunet.training.response_problem import Band, ResponseProblem, SmoothParameters
from cpunet.training.translated import SimulatedSide

# Shares of a diagonal matrix in the correlations of the functions, and of the weighted means,
# which may be alike for two of many coordinates.
SHRUNK, RIDGE = 0.05, 1e-6


class Sums(NamedTuple):
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

    def __add__(self, other: Sums) -> Sums:  # type: ignore[override]
        return Sums(*map(add, self, other))

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

    Attributes
    ----------
    weights
        Shape (functions, coordinates).
    whiten
        Makes the weighted means uncorrelated, in units of their errors.
    deviations, slopes
        Whitened differences of the two sides, and their derivatives in the coordinates.
    """

    def __init__(self, simulated: Sums, measured: Sums, pairs: float) -> None:
        slopes = np.asarray(simulated.moved / simulated.n)
        covariance = 0.5 * (simulated.covariance + measured.covariance)
        sigma = np.maximum(np.sqrt(covariance.diagonal()), 1e-12)[:, np.newaxis]
        correlation = (1 - SHRUNK) * covariance / sigma / sigma.T + SHRUNK * np.eye(len(sigma))
        self.weights: Values = np.linalg.solve(correlation, slopes / sigma) / sigma
        spread = self.weights.T @ measured.covariance @ self.weights / pairs
        spread += RIDGE * np.diag(spread.diagonal())
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
    pairs
        As of `WeightedMeans`.
    """

    def __init__(
        self,
        simulated: Sequence[Sums],
        measured: Sequence[Sums],
        pairs: float,
    ) -> None:
        def of(left_out: int | None, share: float) -> WeightedMeans:
            sides = [
                sum((sums for k, sums in enumerate(side) if k != left_out), Sums())
                for side in (simulated, measured)
            ]
            return WeightedMeans(sides[0], sides[1], share * pairs)

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


# Bins of the current amplitude are no narrower than twice its noise.
MIN_BIN = 0.006
FOR_WEIGHTS = 4096  # maximum number of pulses for the weights, which need not be exact
PARTS = 10  # parts of the pulses, each left out once to estimate the bias


@dataclass(frozen=True, eq=False)
class ConditionalFunctions:
    """The functions of `Moments`, and its components in bins of the current amplitude."""

    moments: Moments
    centres: Values
    widths: Values

    @classmethod
    def of(cls, moments: Moments, bins: int) -> ConditionalFunctions:
        """Equally populated bins of the data's amplitudes, narrow where these are dense."""
        amplitudes = np.quantile(moments.data.log_amplitude, np.linspace(0.03, 0.995, bins))
        centres = [amplitudes[-1]]
        for amplitude in amplitudes[-2::-1]:
            if centres[-1] - amplitude >= MIN_BIN:
                centres.append(amplitude)
        found = np.array(centres[::-1])
        widths = np.diff(found, prepend=2 * found[0] - found[min(1, len(found) - 1)])
        return cls(moments, found, np.maximum(widths, MIN_BIN))

    def __call__(self, readings: Readings) -> Values:
        """Functions of each pulse, shape (pulses, functions)."""
        values, components, bins = self._parts(readings)
        all_of_them: Values = joined([values, bins, products(components, bins)])
        return all_of_them

    def sum(self, readings: Readings) -> Values:
        """Weighted sum of the functions over pulses, without storing them for each pulse."""
        values, components, bins = self._parts(readings)
        bins = readings.weights[:, np.newaxis] * bins
        both = components.T @ bins
        return np.concatenate([readings.weights @ values, bins.sum(axis=0), both.ravel()])

    def _parts(self, readings: Readings) -> tuple[Values, Values, Values]:
        """The functions of the moments, the components among these, and the bins."""
        values = self.moments.functions(readings)
        first = len(self.moments.config.segments) - 1
        components = values[:, first : first + self.moments.config.components]
        return values, components, self.density(readings.log_amplitude)

    def density(self, log_amplitude: Values) -> Values:
        """Bins of the current amplitude, shape (pulses, bins)."""
        bins: Values = gaussian_bins(log_amplitude, self.centres, self.widths)
        return bins


def refine(near: ResponseProblem, bands: Sequence[Band], bins: int) -> Values:
    """Move a response to where the optimally weighted means of both sides agree.

    Weights and derivatives are evaluated at the current response, which is close to the result;
    see `SmoothParameters` for the coordinates of the steps.

    Parameters
    ----------
    near
        Problem that has been fitted; its response is changed.
    bands
        Bands with all pulses.
    bins
        Number of bins of the current amplitude.

    Returns
    -------
    array
        Covariance of the parameters.
    """
    smooth = near.parameters
    place = smooth.vector()
    weighted = [_Weighted(band, smooth, bins) for band in bands]
    slopes = np.concatenate([w.whole.slopes for w in weighted])

    def residuals(place: Values) -> Values:
        smooth.set(place)
        found = [w.deviations(near.response) for w in weighted]
        return np.concatenate([*found, (place - smooth.centre) / smooth.widths])

    columns = np.concatenate([slopes, np.diag(1 / smooth.widths)])
    end, _ = descend(residuals, place, columns, smooth.low, smooth.high)
    # coordinates that end at their bound are held there: jumps to and from it are not a bias
    held = np.where(end > smooth.low + AT_BOUND, np.nan, end - place)
    prior = (place - smooth.centre) / smooth.widths
    bias = jackknife_bias([w.parts for w in weighted], prior, smooth.widths, held)
    # if there are many pulses, the weights come from only some of those that are compared
    pairs = sum(w.pairs for w in weighted), sum(w.band.pairs for w in weighted)
    bias *= min(1.0, pairs[0] / pairs[1])
    smooth.set(np.maximum(end - bias, smooth.low))
    return smooth.covariance(slopes.T @ slopes)


class _Weighted:
    """Optimally weighted functions of one band."""

    def __init__(self, band: Band, smooth: SmoothParameters, bins: int) -> None:
        self.band, self.functions = band, ConditionalFunctions.of(band.moments, bins)
        data = band.moments.data
        # all parts are spread over the files, where neighbours may be alike
        of_sim, of_data = (
            [spread(n, FOR_WEIGHTS)[part::PARTS] for part in range(PARTS)]
            for n in (len(band.sim), len(data))
        )
        measured = [Sums.of(self.functions(data[rows])) for rows in of_data]
        sim = band.sim.of(np.concatenate(of_sim))
        simulated = _simulated(sim, self.functions, smooth)
        counts = (sum(part.n for part in side) for side in (simulated, measured))
        self.pairs = 1 / sum(1 / n for n in counts)
        self.parts = Parts(simulated, measured, band.pairs)
        self.whole = self.parts.whole
        rows = (slice(first, first + BLOCK) for first in range(0, len(data), BLOCK))
        total = sum(self.functions.sum(data[some]) for some in rows)
        self.wanted = total / len(data) @ self.whole.weights

    def deviations(self, response: ElectronicsResponse) -> Values:
        def of(readings: Readings) -> tuple[Values, ...]:
            return (self.functions.sum(readings),)

        (total,), n = self.band.sim.sums(response, of)
        return np.asarray(self.whole.whiten @ (total / n @ self.whole.weights - self.wanted))


def _simulated(
    sim: SimulatedSide, functions: ConditionalFunctions, smooth: SmoothParameters
) -> list[Sums]:
    """Sums over each part of the simulated pulses, including those of derivatives."""
    size = -(-len(sim) // PARTS)

    def of(
        first: int, values: FloatArray, moved: FloatArray, weights: FloatArray
    ) -> dict[int, Sums]:
        found = {}
        # a block can lie in two parts
        for part in range(first // size, (first + len(values) - 1) // size + 1):
            rows = slice(max(part * size - first, 0), (part + 1) * size - first)
            v, w = values[rows].astype(float), weights[rows].astype(float)
            column = (weights[rows] @ moved[:, rows]).astype(float).T
            found[part] = Sums(w.sum(), w @ v, (w * v.T) @ v, column)
        return found

    blocks = DifferentiableSet(sim).blocks(smooth.ways(sim), functions, of, draws=1)
    return [sum((b[k] for b in blocks if k in b), Sums()) for k in range(PARTS)]
