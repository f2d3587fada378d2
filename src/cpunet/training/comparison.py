r"""Two unpaired sets of pulses compared at every sample, in slices by rank.

What all pulses share, as a ringing of the readout, is seen as precisely as noise permits; what
differs from pulse to pulse, only as precisely as the number of pulses does.  The covariance of
a difference of means therefore has two parts,

.. math:: C = S \left(\frac{1}{n_s} + \frac{1}{n_d}\right) + N \left(\frac{1}{n_d} + r\right),

the shapes' :math:`S` from the simulation without noise and the noise's :math:`N`; r is what
draws of opposite sign leave of the simulated noise.  Compared are

* the means of every sample in slices by rank of the current amplitude, and of the rise from 5
  to 50 %.  Slices are ranks of each side, so they are equally full however much the sides
  differ.  Means are those of bounded functions, :math:`w \tanh((A - m) / w)`, which rare
  pulses do not move;
* the quantiles of both, which say what a rank means.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cpunet.networks.response_layer import Spectrum
from cpunet.training.aligned import Aligned, Floats, Values
from cpunet.training.pulse_sets import Sides

# Derivatives of aligned pulses, given the heights of their records before, in coordinates of
# whatever moves these.
Moved = Callable[[Sides, Aligned, Floats], Any]

# Centres of the slices as ranks of either side.  The highest amplitudes are single sites, which
# differ least in shape.
AMPLITUDE, RISE = "log_amplitude", "rise"
RANKS = {
    AMPLITUDE: np.array([0.03, 0.15, 0.3, 0.45, 0.58, 0.69, 0.78, 0.85, 0.9, 0.94, 0.98]),
    RISE: np.linspace(0.02, 0.98, 8),
}
QUANTILES = np.r_[np.linspace(0.01, 0.95, 13), 0.97, 0.985, 0.995]
_ODDS = QUANTILES / (1 - QUANTILES)
CORRELATION = np.sqrt(np.minimum.outer(_ODDS, _ODDS) / np.maximum.outer(_ODDS, _ODDS))
NONE = np.empty((0, 0))  # derivatives
POOLED = 0.5  # of the shapes' covariance, taken from all slices


@dataclass(frozen=True, eq=False)
class Difference:
    """Means of some functions of the translated pulses less those of the data.

    Parameters
    ----------
    values, covariance
        Differences, and their covariance.
    slopes
        Derivatives in the coordinates of a basis, shape (functions, coordinates).
    parts
        Derivatives (parts, functions, coordinates) and differences (parts, functions) of equal
        parts of the simulated pulses.
    sliced
        Whether it is a slice.
    """

    values: Values
    covariance: Values
    slopes: Values = field(default_factory=lambda: NONE)
    parts: tuple[Values, Values] | None = None
    sliced: bool = False

    @property
    def chi_square(self) -> float:
        """Per function."""
        solved = np.linalg.solve(self.covariance, self.values)
        return float(self.values @ solved) / len(self.values)

    @property
    def shared(self) -> Values:
        """What :math:`J^T C^{-1} d` is on average where both sides agree, (coordinates,).

        It is not zero, since derivatives and differences are of the same pulses.
        """
        assert self.parts is not None
        slopes, values = self.parts
        n, off = len(values), np.linalg.solve(self.covariance, (values - values.mean(axis=0)).T)
        return np.asarray(np.einsum("pfk,fp->k", slopes, off) / (n * (n - 1)))


class Slice:
    """Bounded functions of pulses in a slice, and what follows for their means.

    Parameters
    ----------
    compared
        Both sides.
    of_data, of_sim
        Weights of the measured pulses, and of the simulated ones, shape (draws, pulses).
    rms
        RMS of the noise in each stretch.

    Attributes
    ----------
    rows, weights
        The simulated pulses in the slice, and their weights, shape (draws, pulses).
    data, noisy, slopes
        Functions of measured pulses, and of simulated ones with each draw of the noise, shape
        (draws, pulses, functions); derivatives of those with the first.
    shapes, noise
        Covariances.
    number, left
        Effective number of simulated pulses, and what draws leave of the noise.
    """

    def __init__(
        self, compared: Comparison, of_data: Values, of_sim: Values, rms: Values
    ) -> None:
        self.rows, used = np.flatnonzero(of_sim.any(axis=0)), of_data > 0
        self.weights = of_sim[:, self.rows]
        data = compared.sides.data_view[used].astype(float)
        core = data[of_data[used] > 0.3 * of_data.max()]
        middle = np.median(core, axis=0)
        robust = 1.4826 * np.median(np.abs(core - middle), axis=0)
        scale = compared.width * np.maximum(robust, rms)

        def bounded(values: Floats) -> Values:
            return np.asarray(scale * np.tanh((values.astype(float) - middle) / scale))

        self.data, clean = bounded(data), bounded(compared.clean[self.rows])
        self.noisy = np.array([bounded(view[self.rows]) for view in compared.views])
        self.slopes = 1 - (self.noisy[0] / scale) ** 2
        mean_weights = self.weights.mean(axis=0)
        self.number = effective(mean_weights)
        each = mean_weights / mean_weights.sum()
        centred = (clean - each @ clean) * np.sqrt(each)[:, np.newaxis]
        self.shapes = centred.T @ centred
        moved, total = self.noisy - clean, self.weights.sum()
        root = np.sqrt(self.weights / total)[:, :, np.newaxis] * moved
        root = root.reshape(-1, root.shape[-1])
        self.noise = root.T @ root + 1e-14 * np.eye(root.shape[1])
        # draws of opposite sign cancel as far as they are in the same slice
        sums = np.einsum("dp,dpf->pf", self.weights, moved) / total
        self.left = float((sums**2).sum() / self.noise.trace())


class Comparison:
    """Both sides behind a response.

    Parameters
    ----------
    sides
        Pulses as they enter the readout.
    transfer
        Spectrum of its response.
    width
        Width of the bounded functions in robust standard deviations.
    least
        Least error of a quantile.

    Attributes
    ----------
    noisy
        Translated pulses with each draw of the noise.
    views, clean
        Means of these over the stretches, and of pulses without noise.
    """

    def __init__(
        self, sides: Sides, transfer: Spectrum, width: float, least: float = 1e-6
    ) -> None:
        self.sides, self.width, self.least = sides, width, least
        clean, self.heights = sides.translated(transfer)
        self.noisy = sides.noisy(clean, self.heights)
        self.views = [sides.view(draw.pulses) for draw in self.noisy]
        self.clean = sides.view(sides.read(clean, self.heights).pulses)

    def differences(self, basis: Moved | None = None) -> list[Difference]:
        """Differences of quantiles, then of slices, with derivatives in a basis if given."""
        moves = None if basis is None else basis(self.sides, self.noisy[0], self.heights)
        quantiles, slices = zip(*(self._by(by, moves) for by in RANKS), strict=True)
        return [*quantiles, *(difference for own in slices for difference in own)]

    def mean_pulse(self) -> Values:
        """Deviation of the mean of all pulses in its standard errors, by stretch.

        It is 0 within a sample of the half height, where all pulses are aligned.
        """
        n, noise = len(self.sides.data), self.views[0] - self.clean
        rms = np.sqrt(np.mean(noise**2, axis=0, dtype=float))
        whole = Slice(self, np.ones(n), np.ones((len(self.noisy), len(self.sides))), rms)
        variance = whole.shapes.diagonal() * (1 / whole.number + 1 / n)
        variance = variance + whole.noise.diagonal() * (1 / n + whole.left)
        means = whole.noisy.mean(axis=(0, 1)), whole.data.mean(axis=0)
        z = (means[0] - means[1]) / np.sqrt(variance)
        aligned = np.abs(self.sides.time_ns) <= self.sides.frame.dt_ns
        return np.where(aligned, 0.0, z)

    def _by(self, by: str, moves: Any) -> tuple[Difference, list[Difference]]:
        """Differences of quantiles of a quantity, and of means in slices of it."""
        values = [getattr(draw, by) for draw in self.noisy]
        every, own, of_quantiles = np.concatenate(values), getattr(self.sides.data, by), NONE
        quantiles, errors = np.quantile(every, QUANTILES), []
        for of_side, n in ((own, len(own)), (every, len(self.sides))):
            # Half of those an error of rank around: where a rare population begins, as that of
            # events at the contact, as large as the jump to it, on whichever side of it.
            rank = np.sqrt(QUANTILES * (1 - QUANTILES) / n)
            ends = (np.quantile(of_side, (QUANTILES + s * rank).clip(0, 1)) for s in (1, -1))
            errors.append(0.5 * np.subtract(*ends))
        error = np.hypot(*errors)
        covariance = np.outer(error, error) * CORRELATION + self.least**2 * np.eye(len(error))
        if moves is not None:
            near, moved = hats(values[0], quantiles)[0], getattr(moves, by)
            counts = np.maximum(near.sum(axis=0), 1e-9)[:, np.newaxis]
            of_quantiles = near.T @ moved / counts
            # relative to pulses of the same rank, with which slices move
            moved = moved - near @ of_quantiles
        difference = quantiles - np.quantile(own, QUANTILES)
        whole = Difference(difference, covariance, of_quantiles)

        of_data, _ = hats(own, np.quantile(own, RANKS[by]))
        centres = np.quantile(every, RANKS[by])
        parts = list[tuple[Slice, float, Values, Values]]()
        of_sim, turned = zip(*(hats(value, centres) for value in values), strict=True)
        noise = self.views[0] - self.clean
        rms = np.sqrt(np.mean(noise**2, axis=0, dtype=float))
        for k in range(len(centres)):
            here = Slice(self, of_data[:, k], np.array([of[:, k] for of in of_sim]), rms)
            used, slopes = of_data[of_data[:, k] > 0, k], NONE
            mean = np.einsum("dp,dpf->f", here.weights, here.noisy) / here.weights.sum()
            difference = mean - used @ here.data / used.sum()
            if moves is not None:
                total = here.weights[0].sum()
                each = here.weights[0] / total
                slopes = moves.mean(here.rows, each[:, np.newaxis] * here.slopes)
                relative = here.noisy[0] - each @ here.noisy[0]
                sliding = relative * (turned[0][here.rows, k] / total)[:, np.newaxis]
                slopes += sliding.T.astype(np.float32) @ moved[here.rows]
            parts.append((here, effective(used), difference, slopes))
        shapes = sum(here.shapes for here, *_ in parts) / len(parts)
        of_noise = sum(here.noise for here, *_ in parts) / len(parts)
        # the inverse of a covariance from n samples is too large (Hartlap, A&A 464 (2007) 399)
        samples = max(1.0, 0.5 * len(values)) * len(self.sides)
        of_noise *= samples / max(samples - len(of_noise), 0.2 * samples)
        slices = []
        for here, n_data, difference, slopes in parts:
            covariance = (1 - POOLED) * here.shapes + POOLED * shapes
            covariance = covariance * (1 / here.number + 1 / n_data)
            covariance = covariance + of_noise * (1 / n_data + here.left)
            slices.append(Difference(difference, covariance, slopes, sliced=True))
        return whole, slices


def effective(weights: Values) -> float:
    """Number of pulses of equal weight with the same error of the mean."""
    return float(weights.sum() ** 2 / (weights @ weights))


def hats(values: Values, centres: Values) -> tuple[Values, Values]:
    """Triangular bins that add up to 1, and their derivatives, shape (values, centres).

    Examples
    --------
    >>> bins, derivatives = hats(np.array([0.25, 9.0]), np.array([0.0, 1.0, 2.0]))
    >>> bins.tolist(), derivatives[0].tolist()
    ([[0.75, 0.25, 0.0], [0.0, 0.0, 1.0]], [-1.0, 1.0, 0.0])
    """
    low = (np.searchsorted(centres, values) - 1).clip(0, len(centres) - 2)
    distances, rows = centres[low + 1] - centres[low], np.arange(len(values))
    place = (values - centres[low]) / distances
    slope = ((place > 0) & (place < 1)) / distances
    place = place.clip(0, 1)
    bins, derivatives = np.zeros((2, len(values), len(centres)))
    bins[rows, low], bins[rows, low + 1] = 1 - place, place
    derivatives[rows, low], derivatives[rows, low + 1] = -slope, slope
    return bins, derivatives
