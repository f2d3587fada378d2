"""Effect of a misfit on the current amplitude, which users cut on.

With enough pulses any chain differs significantly from the true one: chi-square grows with
their number.  What matters is the effect of the difference.  It is therefore also given as the
shift of the current amplitude (A of A/E) that would best match the translated distribution to
the data.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.moments import Readings, Values
from cpunet.training.optimal_weights import ConditionalFunctions
from cpunet.training.response_problem import Band

BINS = 32  # of the logarithm of the amplitude
STEP = 0.002  # of the logarithm of the amplitude, for the derivative


def amplitude_shift(
    response: ElectronicsResponse, bands: Sequence[Band]
) -> tuple[float, float]:
    """Relative shift that the translated current amplitudes need, and its error.

    It is a least-squares fit to the densities of its logarithm, with their covariance from the
    data's events.

    Parameters
    ----------
    response
        Response that translates the simulated pulses.
    bands
        Bands to compare.
    """
    weight = weighted = 0.0
    for band in bands:
        functions = ConditionalFunctions.of(band.moments, BINS)
        density, slope = _density(band, functions, response)
        values = functions.density(band.moments.data.log_amplitude)
        inverse = np.linalg.inv(np.cov(values.T) / band.pairs + 1e-12 * np.eye(len(slope)))
        weight += float(slope @ inverse @ slope)
        weighted += float(slope @ inverse @ (values.mean(axis=0) - density))
    return weighted / weight, weight**-0.5


def _density(
    band: Band, functions: ConditionalFunctions, response: ElectronicsResponse
) -> tuple[Values, Values]:
    """Mean densities of translated amplitudes, and their derivatives in the shift."""

    def of(readings: Readings) -> tuple[Values, ...]:
        logs = readings.log_amplitude
        return tuple(
            readings.weights @ functions.density(logs + shift) for shift in (0.0, STEP, -STEP)
        )

    (here, up, down), n = band.sim.sums(response, of)
    return here / n, (up - down) / (2 * STEP * n)
