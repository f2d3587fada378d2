"""Effect of a misfit on the current amplitude, which users cut on.

With enough pulses any chain differs significantly from the true one: chi-square grows with
their number.  What matters is the effect of the difference.  It is therefore also given as the
shift of the current amplitude (A of A/E) that would best match the translated distribution to
the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpunet.networks.response_layer import Readout
from cpunet.training.moments import Readings, Values
from cpunet.training.optimal_weights import ConditionalFunctions
from cpunet.training.response_problem import Band

BINS = 32  # of the logarithm of the amplitude
STEP = 0.002  # of the logarithm of the amplitude, for the derivative
NEAR = 0.02  # maximum shift in which densities are linear without doubt


class _Shift(NamedTuple):
    """Shift by a linear fit, the chi-square where it starts, and the shift of the mean."""

    chi_square: float
    shift: float
    error: float
    of_mean: float


def amplitude_shift(response: Readout, bands: Sequence[Band]) -> tuple[float, float]:
    """Relative shift that the translated current amplitudes need, and its error.

    It is a least-squares fit to the densities of its logarithm, with their covariance from the
    data's events.  If the mean logarithms differ much, the fit starts from their difference,
    unless the densities agree better without it.

    Parameters
    ----------
    response
        Response that translates the simulated pulses.
    bands
        Bands to compare.
    """
    found = _linear_fit(response, bands, 0.0)
    if abs(found.of_mean) > NEAR:
        found = min(found, _linear_fit(response, bands, found.of_mean))
    return found.shift, found.error


def _linear_fit(response: Readout, bands: Sequence[Band], start: float) -> _Shift:
    """Fit from amplitudes that are already shifted by `start`."""
    chi_square = weight = weighted = weight_of_mean = weighted_mean = 0.0
    for band in bands:
        functions = ConditionalFunctions.of(band.moments, BINS)
        density, slope, mean = _density(band, functions, response, start)
        logs = band.moments.data.log_amplitude
        values = functions.density(logs)
        apart = values.mean(axis=0) - density
        inverse = np.linalg.inv(np.cov(values.T) / band.pairs + 1e-12 * np.eye(len(slope)))
        chi_square += float(apart @ inverse @ apart)
        weight += float(slope @ inverse @ slope)
        weighted += float(slope @ inverse @ apart)
        weight_of_mean += band.pairs
        weighted_mean += band.pairs * float(logs.mean() - mean)
    weight = max(weight, 1.0)  # an error of more than 100 % is that of no overlap
    shift = start + weighted / weight
    return _Shift(chi_square, shift, weight**-0.5, weighted_mean / weight_of_mean)


def _density(
    band: Band, functions: ConditionalFunctions, response: Readout, start: float
) -> tuple[Values, Values, Values]:
    """Mean densities of translated amplitudes, derivatives in the shift, and mean logarithm."""

    def of(readings: Readings) -> tuple[Values, ...]:
        logs, weights = readings.log_amplitude, readings.weights
        shifts = (start, start + STEP, start - STEP)
        return (*(weights @ functions.density(logs + s) for s in shifts), weights @ logs)

    (here, up, down, total), n = band.sim.sums(response, of)
    return here / n, (up - down) / (2 * STEP * n), total / n
