"""Coordinates in which pulses depend nearly linearly on the parameters of a response.

Two poles act alike: pulses depend on the mean of their logarithms and on the *square* of their
difference.  Where they are equal, derivatives with respect to the difference vanish, and steps
along it go astray.
"""

from __future__ import annotations

import numpy as np

from cpunet.training.moments import Values
from cpunet.training.response_problem import Parameters

POLES = "log_poles_ns"
# For the square of half the difference of two logarithms: width of the prior, and step of the
# finite differences (times of 44 and 36 ns instead of 40 ns twice).
SQUARE_WIDTH, SQUARE_STEP = 0.25, 0.01


class SmoothParameters:
    """The parameters, with mean and squared half difference in place of each pair of poles.

    Parameters
    ----------
    parameters
        Parameters of the response.
    """

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters
        poles = [i for i, label in enumerate(parameters.labels) if label == POLES]
        self._pairs = list(zip(poles[::2], poles[1::2], strict=False))
        self.widths, self.steps = parameters.widths.copy(), parameters.steps.copy()
        self.lowest = np.full(len(self.widths), -np.inf)
        for mean, square in self._pairs:
            self.widths[mean] /= np.sqrt(2)
            self.widths[square], self.steps[square] = SQUARE_WIDTH, SQUARE_STEP
            self.lowest[square] = 0.0
        self.centre = self.of(parameters.centre)

    def get(self) -> Values:
        """Coordinates of the current response."""
        return self.of(self.parameters.vector())

    def set(self, place: Values) -> None:
        """Set the response from its coordinates."""
        vector = place.copy()
        for mean, square in self._pairs:
            half = np.sqrt(max(place[square], 0.0))
            vector[mean], vector[square] = place[mean] + half, place[mean] - half
        self.parameters.set(vector)

    def of(self, vector: Values) -> Values:
        """Coordinates of a vector of parameters."""
        place = vector.copy()
        for mean, square in self._pairs:
            first, second = vector[mean], vector[square]
            place[mean], place[square] = 0.5 * (first + second), 0.25 * (first - second) ** 2
        return place

    def by_parameters(self, slopes: Values, vector: Values) -> Values:
        """Convert derivatives (in columns) from coordinates to parameters."""
        turned = slopes.copy()
        for mean, square in self._pairs:
            half = 0.5 * (vector[mean] - vector[square])
            turned[:, mean] = 0.5 * slopes[:, mean] + half * slopes[:, square]
            turned[:, square] = 0.5 * slopes[:, mean] - half * slopes[:, square]
        return turned
