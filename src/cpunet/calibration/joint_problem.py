"""The comparison that chain and physics minimise together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg

from cpunet.calibration.functions import SlicedFunctions
from cpunet.calibration.nearby import Nearby
from cpunet.calibration.nuisances import Physics, Values, priors
from cpunet.errors import CpunetError
from cpunet.networks.response import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import Recipe
from cpunet.training.moments import Readings
from cpunet.training.response_problem import Band, Parameters

RIDGE = 0.05  # share of a diagonal matrix in the correlations of the functions
# Residuals that keep a step within the reach of the slopes, at its end so many.
HOLD = 4.0
# Events from which derivatives are taken, and of each band at the least.
FOR_DERIVATIVES, OF_BAND = 1536, 100
# Simulated pulses of a band that tell how the functions vary.
FOR_COVARIANCE = 4096
# Of the reach of a slope: the step of a finite difference.
FINITE = 0.1


class JointParameters:
    """Parameters of the chain, then free coordinates of the physics, as one vector.

    Parameters
    ----------
    response
        The chain; where it is now its priors are centred.
    physics
        All parameters of the physics.
    coordinates
        Of these, as they are.
    free
        Positions of those that are free.
    given
        Priors that are not the default's, value and error by name.
    """

    def __init__(
        self,
        response: ElectronicsResponse,
        physics: Physics,
        coordinates: Values,
        free: Sequence[int],
        given: Mapping[str, tuple[float, float]],
    ) -> None:
        self.chain, self.given = Parameters(response), given
        self.coordinates, self.free = coordinates.copy(), list(free)
        self.n_chain = len(self.chain.labels)
        chosen = [physics.nuisances[i] for i in self.free]
        known = priors(physics.of(chosen), given)
        self.centre = np.concatenate([self.chain.centre, [p.centre for p in known]])
        self.widths = np.concatenate([self.chain.widths, [p.width for p in known]])
        self.steps = np.concatenate([self.chain.steps, [FINITE * n.reach for n in chosen]])
        self.names = (
            *self.chain.by_name(self.chain.vector()),
            *(nuisance.name for nuisance in chosen),
        )
        bounds = [n.bounds(physics.nominal(n)) for n in chosen]
        self._low, self._high = np.reshape(bounds, (len(chosen), 2)).T

    def vector(self) -> Values:
        """All as one vector."""
        return np.concatenate([self.chain.vector(), self.coordinates[self.free]])

    def set(self, vector: Values) -> None:
        """Take over a vector; coordinates end at their bounds."""
        self.chain.set(vector[: self.n_chain])
        self.coordinates = self.coordinates.copy()
        self.coordinates[self.free] = np.clip(vector[self.n_chain :], self._low, self._high)


class JointProblem:
    """Residuals of functions in slices of drift time, of the priors, and of what else is known.

    Parameters
    ----------
    parameters
        To be found.
    bands
        What is compared; of the simulated pulses their rows, noise and weights.
    functions
        One for each band.
    nearby
        Pulses about a point of the physics.
    energy_kev
        Of its events.
    recipe
        Whose preparation simulated pulses get.
    known
        Deviations, in standard deviations, of what else is known of the coordinates.
    held
        Whether steps beyond the reach of the slopes are to cost.  It is for the way from far:
        how simulated pulses vary there tells nothing of errors.
    """

    def __init__(
        self,
        parameters: JointParameters,
        bands: Sequence[Band],
        functions: Sequence[SlicedFunctions],
        nearby: Nearby,
        energy_kev: Values,
        recipe: Recipe,
        known: Callable[[Values], Values] = lambda _: np.empty(0),
        *,
        held: bool = False,
    ) -> None:
        self.parameters, self.bands, self.nearby = parameters, tuple(bands), nearby
        self.functions, self.known = tuple(functions), known
        self._energy_kev, self._recipe = energy_kev, recipe
        self.held = held
        self.few = fewest(self.bands)
        self.clip = None

    @property
    def clip(self) -> float | None:
        """At how many standard deviations the functions end."""
        return self._clip

    @clip.setter
    def clip(self, clip: float | None) -> None:
        self._clip = clip
        self._wanted, self._sigma, self._whiten = [], [], []
        for band, functions in zip(self.bands, self.functions, strict=True):
            values = functions(band.moments.data, clip)
            covariance = np.cov(values.T) / band.pairs
            if not self.held:
                # of both sides: weights that follow the chances of one would draw the fit to it
                simulated = self._covariance(band, functions) / band.pairs
                covariance = 0.5 * (covariance + simulated)
            sigma = np.maximum(np.sqrt(covariance.diagonal()), 1e-12)
            correlation = (1 - RIDGE) * covariance / sigma[:, np.newaxis] / sigma
            correlation += RIDGE * np.eye(len(sigma))
            self._wanted.append(values.mean(axis=0))
            self._sigma.append(sigma)
            self._whiten.append(scipy.linalg.cholesky(np.linalg.inv(correlation)))

    @property
    def moments(self) -> int:
        """How many functions are compared, of all bands."""
        return sum(len(sigma) for sigma in self._sigma)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the functions; with their band, if there are several."""
        several = len(self.bands) > 1
        return tuple(
            f"{band.name}: {name}" if several else name
            for band, functions in zip(self.bands, self.functions, strict=True)
            for name in functions.names
        )

    def pulls(self, vector: Values) -> Values:
        """Deviations of the functions in standard deviations, correlated as they are."""
        return np.concatenate(self._pulls(vector))

    def chi_square(self, vector: Values) -> float:
        """Of the functions alone."""
        deviations = self._deviations(vector)
        return float(deviations @ deviations)

    def weigh_like(self, other: JointProblem) -> None:
        """Take over errors and correlations of the same functions."""
        self._sigma, self._whiten = other._sigma, other._whiten

    def residuals(self, vector: Values) -> Values:
        """Uncorrelated deviations, and those of all that is known before.

        While steps are held, where only the way matters, of some of the pulses.
        """
        return self._residuals(vector, self.few if self.held else None)

    def _residuals(self, vector: Values, most: int | None) -> Values:
        parameters = self.parameters
        prior = (vector - parameters.centre) / parameters.widths
        deviations = self._deviations(vector, most)
        rows = [deviations, prior, self.known(parameters.coordinates)]
        if self.held:
            nuisances = [self.nearby.simulator.physics.nuisances[i] for i in parameters.free]
            reach = np.array([nuisance.reach for nuisance in nuisances])
            moved = (parameters.coordinates - self.nearby.centre)[parameters.free]
            rows.append(HOLD * moved / reach)
        return np.concatenate(rows)

    def jacobian(self, vector: Values, residuals: Values) -> Values:
        """Derivatives of all residuals, shape (residuals, parameters).

        Of some of the pulses and with one draw of noise: they need not be exact.
        """
        here = self._residuals(vector, self.few)
        columns = []
        for i, step in enumerate(self.parameters.steps):
            moved = vector.copy()
            moved[i] += step
            columns.append((self._residuals(moved, self.few) - here) / step)
        self.parameters.set(vector)
        return np.stack(columns, axis=1)

    def prepared(self, coordinates: Values, most: int | None = None) -> Pulses:
        """Simulated pulses as a readout gets them; the first so many events."""
        pulses = Pulses.of(
            self.nearby.at(coordinates, most),
            dt_ns=self.nearby.simulator.physics.settings.dt_ns,
            energy_kev=self._energy_kev[:most],
        )
        prepared = prepare(pulses, self._recipe.preparation, "simulated")
        if len(prepared) < len(pulses):
            told = ", ".join(f"{n} {reason}" for reason, n in prepared.rejections.items())
            raise CpunetError(
                f"with these physics {len(pulses) - len(prepared)} of {len(pulses)} events "
                f"give no pulse ({told}); narrow the --prior of what is free"
            )
        return prepared.pulses

    def _covariance(self, band: Band, functions: SlicedFunctions) -> Values:
        """Covariance of the functions over the simulated pulses of a band."""
        some = band.sim.first(FOR_COVARIANCE)
        waveforms = self.prepared(self.nearby.centre).waveforms[band.rows[: len(some)]]

        def of(readings: Readings) -> tuple[Values, ...]:
            values = functions(readings, self._clip)
            return readings.weights @ values, (readings.weights * values.T) @ values

        (total, squares), n = replace(some, sim=waveforms).sums(
            self.parameters.chain.response, of, cut=self._clip is None, draws=1
        )
        mean = total / max(n, 1e-9)
        return np.asarray(squares / max(n, 1e-9) - np.outer(mean, mean))

    def _deviations(self, vector: Values, most: int | None = None) -> Values:
        pulls = self._pulls(vector, most)
        return np.concatenate([w @ p for w, p in zip(self._whiten, pulls, strict=True)])

    def _pulls(self, vector: Values, most: int | None = None) -> list[Values]:
        """Deviations of the functions of each band, from the first so many events."""
        parameters = self.parameters
        parameters.set(vector)
        waveforms = self.prepared(parameters.coordinates, most).waveforms
        draws = None if most is None else 1
        found = []
        for i, (band, functions) in enumerate(zip(self.bands, self.functions, strict=True)):
            n_rows = len(band.rows) if most is None else np.searchsorted(band.rows, most)
            some = band.sim.first(int(n_rows))
            rows = band.rows[: len(some)]
            translated = replace(some, sim=waveforms[rows])

            def of(readings: Readings, functions: SlicedFunctions = functions) -> tuple[Values]:
                return (readings.weights @ functions(readings, self._clip),)

            # far from the data many tails are beyond theirs, and none is to be left out
            (total,), n = translated.sums(
                parameters.chain.response, of, cut=self._clip is None, draws=draws
            )
            found.append((total / max(n, 1e-9) - self._wanted[i]) / self._sigma[i])
        return found


def fewest(bands: Sequence[Band]) -> int:
    """How many events, from the first, are enough for derivatives: some of each band."""
    return max(FOR_DERIVATIVES, *(int(band.rows[:OF_BAND][-1]) + 1 for band in bands))
