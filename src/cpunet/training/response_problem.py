"""The comparison that a fit of a response minimises, as a function of its parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy.linalg

from cpunet.networks.response_layer import ElectronicsResponse, padded_length
from cpunet.pulses.container import FloatArray
from cpunet.training.chain_parameters import Parameters, SmoothParameters
from cpunet.training.differentiable import DifferentiableSet, Ways
from cpunet.training.moments import Moments, Readings, Values
from cpunet.training.translated import SimulatedSide


def ways(parameters: Parameters, sim: SimulatedSide) -> Ways:
    """How records of some pulses change with each parameter, those of a stretch last."""
    ends = [parameters.ends(i) for i in parameters.stretched]
    slopes = [slope for _, slope in parameters.slopes_of_transfer(padded_length(sim.length))]

    def of_pulses(rows: slice) -> FloatArray:
        pulses = sim.sim[rows].astype(float)
        found = np.empty((len(ends), *pulses.shape), np.float32)
        for change, (a, b, step) in zip(found, ends, strict=True):
            change[:] = (b.drifted(pulses) - a.drifted(pulses)) / step
        return found

    return Ways(parameters.response, np.stack(slopes), of_pulses)


@dataclass(frozen=True, eq=False)
class Band:
    """Simulated and measured pulses of a band of energy, which are compared with each other.

    Parameters
    ----------
    name
        Energies, as shown to the user.
    sim
        Simulated pulses, and the moments of the measured ones.
    rows
        Rows of the simulated pulses in the set that they were taken from.
    """

    name: str
    sim: SimulatedSide
    rows: npt.NDArray[np.intp]

    @property
    def moments(self) -> Moments:
        """Moments defined by the measured pulses."""
        return self.sim.moments

    @property
    def pairs(self) -> float:
        """Number of pulses that errors refer to: the harmonic sum of both sides."""
        weights = self.sim.weights
        simulated = weights.sum() ** 2 / (weights @ weights)
        return float(1 / (1 / len(self.moments.data) + 1 / simulated))


class ResponseProblem:
    """Residuals of the moments, and the priors, as functions of a vector of parameters.

    Parameters
    ----------
    response
        Response to be fitted.
    bands
        Bands to compare; their moments are concatenated.
    draws
        Number of draws of the noise for each pulse; None for all.
    """

    def __init__(
        self, response: ElectronicsResponse, bands: Sequence[Band], draws: int | None = None
    ) -> None:
        self.parameters = SmoothParameters(response)
        self.bands, self.draws = tuple(bands), draws
        self.clip: float | None = None
        self._comparisons = [BandComparison(band, draws=draws) for band in self.bands]

    @property
    def response(self) -> ElectronicsResponse:
        """The response that is fitted."""
        return self.parameters.response

    @property
    def moments(self) -> int:
        """Number of moments in all bands."""
        return sum(len(band.moments.names) for band in self.bands)

    @property
    def slope(self) -> float:
        """Slope of the logarithm of the data's tails, per sample."""
        return float(np.mean([band.moments.slope for band in self.bands]))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the moments, with their band if there are several."""
        several = len(self.bands) > 1
        return tuple(
            f"{band.name}: {name}" if several else name
            for band in self.bands
            for name in band.moments.names
        )

    def of(
        self, response: ElectronicsResponse, bands: Sequence[Band] | None = None
    ) -> ResponseProblem:
        """The same for another response, which the priors are centred on, or other pulses."""
        return ResponseProblem(response, bands or self.bands, self.draws)

    def pulls(self, vector: Values) -> Values:
        """Deviations of the moments in standard deviations; they are correlated."""
        self.parameters.set(vector)
        found = [c.pulls(self.response, self.clip) for c in self._comparisons]
        return np.concatenate(found)

    def deviations(self, vector: Values) -> Values:
        """Deviations of the moments, uncorrelated."""
        self.parameters.set(vector)
        found = [c.whiten @ c.pulls(self.response, self.clip) for c in self._comparisons]
        return np.concatenate(found)

    def residuals(self, vector: Values) -> Values:
        """Uncorrelated deviations, and those of the priors."""
        prior = (vector - self.parameters.centre) / self.parameters.widths
        return np.concatenate([self.deviations(vector), prior])

    @property
    def cost(self) -> float:
        """Sum of the squared residuals where the response is."""
        residuals = self.residuals(self.parameters.vector())
        return float(residuals @ residuals)

    def jacobian(self, vector: Values) -> Values:
        """Derivatives of all residuals, shape (residuals, parameters)."""
        return np.concatenate([self.derivatives(vector), np.diag(1 / self.parameters.widths)])

    def derivatives(self, vector: Values) -> Values:
        """Derivatives of the deviations, shape (moments, parameters)."""
        self.parameters.set(vector)
        found = [c.derivatives(self.parameters, self.clip) for c in self._comparisons]
        return np.concatenate(found)


class BandComparison:
    """Moments of the data in one band, and their covariance."""

    def __init__(self, band: Band, draws: int | None = None) -> None:
        self.sim, self.moments, self.draws = band.sim, band.moments, draws
        values = self.moments.values
        self.wanted = values.mean(axis=0)
        covariance = np.cov(values.T) / band.pairs
        self.sigma = np.maximum(np.sqrt(covariance.diagonal()), 1e-12)
        correlation = covariance / self.sigma[:, np.newaxis] / self.sigma
        ridge = self.moments.config.ridge
        correlation = (1 - ridge) * correlation + ridge * np.eye(len(correlation))
        self.whiten = scipy.linalg.cholesky(np.linalg.inv(correlation))

    def derivatives(self, parameters: Parameters, clip: float | None) -> Values:
        """Derivatives of the uncorrelated deviations, shape (moments, parameters)."""
        functions = partial(self.moments.functions, clip=clip)
        records = ways(parameters, self.sim)
        slopes = DifferentiableSet(self.sim).slopes(records, functions, draws=self.draws)
        return np.asarray(self.whiten @ (slopes.T / self.sigma).T)

    def pulls(self, response: ElectronicsResponse, clip: float | None) -> Values:
        def of(readings: Readings) -> tuple[Values, ...]:
            return (readings.weights @ self.moments.functions(readings, clip),)

        # far from the data many tails are outside their range, and none may be excluded
        (total,), n = self.sim.sums(response, of, cut=clip is None, draws=self.draws)
        return np.asarray((total / max(n, 1e-9) - self.wanted) / self.sigma)
