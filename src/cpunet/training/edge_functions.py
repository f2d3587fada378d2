"""Functions of a pulse whose means are compared to train a network that corrects a chain.

The network is trained like the chain is fitted: on means over events, weighted by their
covariance (see `cpunet.training.moments`).  With a thousand pulses per side these show what
distances between whole distributions do not.  To the functions of the fit are added some that a
network can change and a chain cannot: the slopes of the edge, and shape and slope in bins of
the current amplitude, which separates single-site from multi-site pulses.  All are
differentiable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
import torch
from torch import Tensor, nn

from cpunet.networks.response_layer import PADDING_BEFORE
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import current_amplitude_kernel
from cpunet.recipes.schema import Recipe
from cpunet.training.half_maximum_alignment import at_half_maximum
from cpunet.training.moments import EDGE, Moments, Values
from cpunet.training.optimal_weights import ConditionalFunctions
from cpunet.training.translated import DELAY

# Samples around the half maximum whose derivative is compared, and number of its components.
SLOPE_BEFORE, SLOPE_AFTER, SLOPE_COMPONENTS = 60, 90, 16
# Number of bins of the current amplitude, and of components of shape and slope in each.
BINS, BIN_COMPONENTS, BIN_SLOPES = 8, 12, 8


class Readings(NamedTuple):
    """Quantities read from each pulse.

    Parameters
    ----------
    stretches, shape, slope
        In standard deviations of the data, shapes (pulses, quantities).
    log_amplitude
        Logarithm of the current amplitude, shape (pulses,).
    """

    stretches: Tensor
    shape: Tensor
    slope: Tensor
    log_amplitude: Tensor


class EdgeFunctions:
    """Functions of a pulse, defined by measured pulses.

    Parameters
    ----------
    data
        Prepared measured windows, shape (n, samples).
    recipe
        Recipe that matches a response.
    """

    def __init__(self, data: FloatArray, recipe: Recipe) -> None:
        self.training, self.preparation = recipe.matching.training, recipe.preparation
        moments = Moments.of_data(data, self.training, recipe.preparation)
        self.level = moments.level
        self.middle, self.components = map(torch.from_numpy, (moments.mean, moments.components))
        self.segments = torch.from_numpy(moments.stretches)
        n = self.segments.shape[1]
        self.centres, self.spreads = (
            torch.from_numpy(values[:n]).float()
            for values in (moments.centres, moments.spreads)
        )
        narrow = ConditionalFunctions.of(moments, self.training.conditional_bins)
        self.narrow = torch.cat(
            [
                _as_bins(moments.amplitude_centres, moments.amplitude_widths),
                _as_bins(narrow.centres, narrow.widths),
            ],
            dim=1,
        )
        self.kernel = torch.from_numpy(current_amplitude_kernel())
        aligned = self._aligned_windows(data)
        slopes = self._slopes(aligned)
        self.mean_slope = slopes.mean(dim=0)
        _, sizes, axes = torch.linalg.svd(slopes - self.mean_slope, full_matrices=False)
        scale = (sizes[:SLOPE_COMPONENTS] / len(slopes) ** 0.5).clamp_min(1e-9)
        self.axes = axes[:SLOPE_COMPONENTS].T / scale
        edges = np.quantile(
            self._log_amplitudes(aligned).numpy(), np.linspace(0.05, 0.99, BINS)
        )
        widths = np.diff(edges, prepend=2 * edges[0] - edges[1])
        self.wide = _as_bins(edges, np.maximum(widths, self.training.amplitude_width))

    def of_windows(self, windows: FloatArray) -> Tensor:
        """Functions of prepared measured windows that can be aligned, (pulses, functions)."""
        return self._functions(self._read(self._aligned_windows(windows)))

    def of_records(self, records: Tensor) -> Tensor:
        """The same for records with noise, of about the height of prepared pulses."""
        last = PADDING_BEFORE + self.preparation.samples_before + DELAY
        return self._functions(self._read(self._aligned(records, last)))

    def _aligned_windows(self, windows: FloatArray) -> Tensor:
        whole = torch.from_numpy(np.ascontiguousarray(windows))
        return self._aligned(whole, self.preparation.samples_before + 1)

    def _aligned(self, records: Tensor, last: int) -> Tensor:
        level = self.preparation.tail_level
        found = at_half_maximum(records, self.level, last, self.training, level)
        return found[torch.isfinite(found).all(dim=1)]

    def _read(self, aligned: Tensor) -> Readings:
        clip = self.training.clip
        stretches = (aligned @ self.segments - self.centres) / self.spreads
        shape = (aligned - self.middle) @ self.components
        slope = (self._slopes(aligned) - self.mean_slope) @ self.axes
        return Readings(
            stretches.clamp(-clip, clip),
            shape.clamp(-clip, clip),
            slope.clamp(-clip, clip),
            self._log_amplitudes(aligned),
        )

    def _functions(self, read: Readings) -> Tensor:
        wide = _density(read.log_amplitude, self.wide)
        binned = torch.cat([read.shape[:, :BIN_COMPONENTS], read.slope[:, :BIN_SLOPES]], dim=1)
        return torch.cat(
            [
                read.stretches,
                read.shape,
                read.slope,
                read.shape[:, : self.training.squares].square(),
                read.slope.square(),
                _density(read.log_amplitude, self.narrow),
                wide,
                (binned[:, :, None] * wide[:, None]).flatten(1),
            ],
            dim=1,
        )

    def _slopes(self, aligned: Tensor) -> Tensor:
        return self._current(aligned, SLOPE_BEFORE, SLOPE_AFTER)

    def _log_amplitudes(self, aligned: Tensor) -> Tensor:
        current = self._current(aligned, EDGE, EDGE)
        phases = nn.functional.conv1d(current[:, None], self.kernel[:, None])
        return phases.flatten(1).amax(dim=1).clamp_min(1e-4).log()

    def _current(self, aligned: Tensor, before: int, after: int) -> Tensor:
        """Current from so many samples before the half maximum to so many after it."""
        middle = self.training.before
        return torch.diff(aligned[:, max(middle - before, 0) : middle + after], dim=1)


class EdgeMisfit:
    """Chi-square per function between translated pulses and measured ones.

    Parameters
    ----------
    values
        Functions of the measured pulses that define the weights, (pulses, functions).
    ridge
        Fraction of the identity in their correlation matrix.
    """

    def __init__(self, values: Tensor, ridge: float) -> None:
        covariance = np.cov(values.numpy().T.astype(float))
        sigma = np.maximum(np.sqrt(covariance.diagonal()), 1e-9)
        correlation = (1 - ridge) * covariance / sigma[:, np.newaxis] / sigma
        correlation += ridge * np.eye(len(sigma))
        whiten = scipy.linalg.cholesky(np.linalg.inv(correlation)) / sigma
        self.whiten = torch.from_numpy(whiten).float()

    def __call__(self, made: Tensor, measured: Tensor, pairs: float) -> Tensor:
        """Compare two means, shape (functions,); `pairs` is the harmonic sum of the counts."""
        apart = self.whiten @ (made - measured)
        return pairs * apart.square().mean()


def _as_bins(centres: Values, widths: Values) -> Tensor:
    return torch.from_numpy(np.stack([centres, widths])).float()


def _density(log_amplitude: Tensor, bins: Tensor) -> Tensor:
    """Gaussian bins of the current amplitude, shape (pulses, bins)."""
    return torch.exp(-0.5 * ((log_amplitude[:, None] - bins[0]) / bins[1]) ** 2)
