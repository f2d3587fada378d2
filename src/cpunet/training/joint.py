"""Two unpaired sets of pulses compared jointly: how shapes go with the current amplitude."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property
from typing import Self

import numpy as np
import scipy.linalg

from cpunet.networks.response_layer import Spectrum
from cpunet.pulses.container import FloatArray
from cpunet.training.aligned import Aligned, Changes, Derivatives, Floats, Values
from cpunet.training.comparison import Difference
from cpunet.training.pulse_sets import Sides

COMPONENTS, SEGMENTS, BINS = 24, 20, 16
CLIPPED = 4.0  # robust standard deviations at which components and segments are clipped
# Least width of a bin of the logarithm of the amplitude, twice the effect of noise; ranks of
# the lowest and the highest.
NARROWEST, OF_BINS = 0.006, (0.03, 0.995)
SHRUNK = 0.05  # share of a diagonal matrix in the covariance
# Width of the logarithm of the current amplitude in which the peak of the single sites is the
# highest, and bins about it.
PEAK_WIDTH, ABOUT_PEAK = 0.01, np.linspace(-0.03, 0.02, 10)
FOR_PRODUCTS = 600  # pulses of a side, of which products have a covariance
TINY = 1e-9  # least scale
PARTS = 20  # of the pulses, which say how differences go with derivatives


class Joint:
    r"""How shapes go with the current amplitude, for any response: all of it compared at once.

    A bandwidth shows most in how the shape of a pulse goes with its current amplitude: it
    changes that of single sites, which is the highest, otherwise than that of
    others.  Compared are therefore the principal components :math:`c_i` of the aligned
    pulses, their means over segments, smooth bins :math:`b_k` of the logarithm of the
    current amplitude, and the products :math:`c_i b_k`.  Means of all these differ by what
    their joint covariance permits, that of single pulses of both sides over their numbers:
    these are the efficient weights of the generalised method of moments (Hansen,
    Econometrica 50 (1982) 1029).

    They determine the current amplitude two to four times better than `Comparison`, but
    trust in the simulated shapes, and see no small differences that all pulses share.

    Many functions of few pulses would pull a fit towards responses by which they vary less:
    the same pulses say how far the means are off and how they change (Newey and Smith,
    Econometrica 72 (2004) 219).  Parts of the pulses tell how both go together, which is
    subtracted.

    Parameters
    ----------
    sides
        Pulses; the measured ones define the functions.
    wider
        Factor of the widths of the bins, and of where components are clipped, which otherwise
        are all the same if the sides differ much.
    products
        Whether products of components and bins are compared, too.
    """

    def __init__(self, sides: Sides, wider: float = 1.0, *, products: bool = True) -> None:
        self.sides, self.clipped = sides, CLIPPED * wider
        self.products = products and min(len(sides), len(sides.data)) >= FOR_PRODUCTS
        views = sides.data_view.astype(float)
        self.middle, size = np.median(views, axis=0), views.shape[1]
        largest = (max(size - COMPONENTS, 0), size - 1)
        _, axes = scipy.linalg.eigh(np.cov(views.T), subset_by_index=largest)
        segments = np.arange(size) * SEGMENTS // size
        matrix = np.column_stack([segments[:, np.newaxis] == np.arange(SEGMENTS), axes])
        values = (views - self.middle) @ matrix
        centre = np.median(values, axis=0)
        scale = 1.4826 * np.median(np.abs(values - centre), axis=0)
        scale = np.maximum(scale, TINY)
        self.matrix, self.centre = matrix / scale, centre / scale
        logs = np.quantile(sides.data.log_amplitude, np.linspace(*OF_BINS, BINS))
        centres: list[float] = []
        for log in logs[::-1]:
            if not centres or centres[-1] - log >= NARROWEST:
                centres.append(log)
        self.places = np.array(centres[::-1])
        first = 2 * self.places[0] - self.places[min(1, len(centres) - 1)]
        self.widths = wider * np.maximum(np.diff(self.places, prepend=first), NARROWEST)

    @cached_property
    def data(self) -> Values:
        """Functions of the measured pulses, shape (pulses, functions)."""
        return self._functions(self.sides.data)

    def with_sides(self, sides: Sides) -> Self:
        """The same functions of other simulated pulses."""
        other = copy.copy(self)
        other.sides = sides
        return other

    def taking(self, sim: FloatArray) -> Self:
        """The same with other simulated pulses of the same events."""
        sides = copy.copy(self.sides)
        sides.take(sim)
        return self.with_sides(sides)

    def some(self, rows: slice) -> Self:
        """The same functions of some pulses of both sides."""
        other = self.with_sides(self.sides.of_events(rows))
        other.sides.data, other.data = self.sides.data[rows], self.data[rows]
        return other

    def difference(
        self,
        transfer: Spectrum,
        basis: Values | None = None,
        changes: Sequence[FloatArray] = (),
    ) -> Difference:
        """Compare the pulses translated by a response, with derivatives if asked.

        Parameters
        ----------
        transfer
            Spectrum of the response.
        basis
            Changes of the step response, see `Derivatives`; None for no derivatives.
        changes
            Derivatives of the simulated pulses in other coordinates, which follow.
        """
        clean, heights = self.sides.translated(transfer)
        noisy = self.sides.noisy(clean, heights)
        each = [self._functions(draw) for draw in noisy]
        covariance = self.covariance(0.5 * (np.cov(each[0].T) + np.cov(self.data.T)))
        values = np.mean(each, axis=0)
        off = values.mean(axis=0) - self.data.mean(axis=0)
        if basis is None:
            return Difference(off, covariance)
        moves: list[Derivatives | Changes] = [Derivatives(basis, self.sides, noisy[0], heights)]
        if changes:
            records = [self.sides.changed(draw, transfer, heights) for draw in changes]
            moves.append(Changes(self.sides, noisy[0], records))
        of_each = np.concatenate([self._each(noisy[0], some) for some in moves], axis=2)
        of_log = np.concatenate([some.log_amplitude for some in moves], axis=1)
        parts = np.array_split(np.arange(len(clean)), PARTS)
        slopes = np.array([self._slopes(noisy[0][of], of_each[of], of_log[of]) for of in parts])
        means = np.array([part.mean(axis=0) for part in np.array_split(values, PARTS)])
        return Difference(off, covariance, slopes.mean(axis=0), (slopes, means))

    def covariance(self, of_each: Values) -> Values:
        """Covariance of a difference of means from that of single pulses."""
        of_means = of_each * (1 / len(self.sides) + 1 / len(self.data))
        variances = SHRUNK * of_means.diagonal() + TINY**2
        return np.asarray((1 - SHRUNK) * of_means + np.diag(variances))

    def _functions(self, pulses: Aligned) -> Values:
        """Of each pulse, shape (pulses, functions)."""
        shape, (bins, _) = self._shape(pulses), self._bins(pulses)
        if not self.products:
            return np.concatenate([shape, bins], axis=1)
        products = bins[:, :, np.newaxis] * shape[:, np.newaxis, SEGMENTS:]
        return np.concatenate([shape, bins, products.reshape(len(bins), -1)], axis=1)

    def _shape(self, pulses: Aligned) -> Values:
        """Segments and components in robust standard deviations."""
        views = self.sides.view(pulses.pulses).astype(float) - self.middle
        shape: Values = views @ self.matrix - self.centre
        return shape.clip(-self.clipped, self.clipped)

    def _bins(self, pulses: Aligned) -> tuple[Values, Values]:
        """Bins of the amplitude, and their derivatives, shape (pulses, bins)."""
        return gaussian_bins(pulses.log_amplitude, self.places, self.widths)

    def _each(self, pulses: Aligned, moves: Derivatives | Changes) -> Floats:
        """Derivatives of segments and components, (pulses, functions, coordinates)."""
        changes = moves.each(self.matrix)
        changes[np.abs(self._shape(pulses)) >= self.clipped] = 0
        return changes

    def _slopes(self, pulses: Aligned, changes: Floats, of_log: Floats) -> Values:
        """Derivatives of the means from those of each pulse, (functions, coordinates)."""
        shape, (bins, turned) = self._shape(pulses), self._bins(pulses)
        n, coordinates = of_log.shape
        of_bins = turned.T @ of_log
        if not self.products:
            return np.asarray(np.concatenate([changes.sum(axis=0), of_bins]) / n)
        own = changes[:, SEGMENTS:].reshape(n, -1)
        sliding = shape[:, SEGMENTS:, np.newaxis] * of_log[:, np.newaxis]
        products = bins.T @ own + turned.T @ sliding.reshape(n, -1)
        parts = [changes.sum(axis=0), of_bins, products.reshape(-1, coordinates)]
        return np.asarray(np.concatenate(parts) / n)


class SingleSites(Joint):
    r"""Only place and shape of the peak of the current amplitude of single sites.

    How many pulses are in this peak depends on where the gammas come from, the peak does not.
    Of bins :math:`b_k` about it, with shares :math:`p_k` in the data, the functions are
    :math:`b_k - p_k \sum_j b_j`.
    """

    def __init__(self, sides: Sides) -> None:
        self.sides = sides
        logs = np.sort(sides.data.log_amplitude)
        counts = np.searchsorted(logs, logs + PEAK_WIDTH) - np.arange(len(logs))
        self.places = logs[counts.argmax()] + 0.5 * PEAK_WIDTH + ABOUT_PEAK
        self.widths = np.full(len(ABOUT_PEAK), np.diff(ABOUT_PEAK).max())
        shares = self._bins(sides.data)[0].mean(axis=0)
        # the last follows from the others
        self.balance = (np.eye(len(shares)) - shares / shares.sum())[:, :-1]

    def _functions(self, pulses: Aligned) -> Values:
        return np.asarray(self._bins(pulses)[0] @ self.balance)

    def _each(self, pulses: Aligned, moves: Derivatives | Changes) -> Floats:
        return np.empty((len(pulses), 0, moves.log_amplitude.shape[1]), np.float32)

    def _slopes(self, pulses: Aligned, changes: Floats, of_log: Floats) -> Values:
        moved = self._bins(pulses)[1].T @ of_log / len(pulses)
        return np.asarray(self.balance.T @ moved)


def gaussian_bins(values: Values, centres: Values, widths: Values) -> tuple[Values, Values]:
    """Smooth bins, and their derivatives, shape (values, centres)."""
    place = (values[:, np.newaxis] - centres) / widths
    bins = np.exp(-0.5 * place**2)
    return bins, -place / widths * bins
