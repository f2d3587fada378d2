"""The comparison of simulation and data that chain and physics minimise together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy.linalg

from cpunet.calibration.nearby import FloatArray, Nearby, cut
from cpunet.calibration.nuisances import Physics, Values
from cpunet.calibration.sliced_functions import SlicedFunctions
from cpunet.errors import CpunetError
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import Recipe
from cpunet.training.chain_parameters import SmoothParameters
from cpunet.training.differentiable import DifferentiableSet
from cpunet.training.moments import Readings, Rows
from cpunet.training.response_problem import Band, ways
from cpunet.training.translated import SimulatedSide

RIDGE = 0.05  # fraction of the identity in the correlation matrix of the functions
# Residual that keeps a step within the reach of the derivatives: its size at the reach.
HOLD = 4.0
# Number of events for derivatives, and minimum number of each band.
FOR_DERIVATIVES, OF_BAND = 1536, 100
# Simulated pulses of a band for the covariance of the functions.
FOR_COVARIANCE = 4096
OfPulses = Callable[[slice], FloatArray]
# Step in the physics, in which pulses are linear, as a fraction of the reach of a derivative.
STEP = 0.1


class JointParameters:
    """Parameters of the chain and free coordinates of the physics as one vector.

    Parameters
    ----------
    response
        The chain.
    physics
        All parameters of the physics.
    coordinates
        Current coordinates of the physics.
    free
        Positions of the free coordinates.
    given
        Priors that replace the defaults: value and error by name.
    start
        The chain before any fit, on which the priors of the same parameters are centred; those
        of others on their current values. Centred on the last fit, they would make a result
        depend on where the first one ended.
    """

    def __init__(
        self,
        response: ElectronicsResponse,
        physics: Physics,
        coordinates: Values,
        free: Sequence[int],
        given: Mapping[str, tuple[float, float]],
        start: ElectronicsResponse,
    ) -> None:
        self.chain, self.given, self.start = SmoothParameters(response, start), given, start
        self.coordinates, self.free = coordinates.copy(), list(free)
        self.n_chain = len(self.chain.labels)
        chosen = [physics.nuisances[i] for i in self.free]
        centres, widths = physics.priors(given)
        self.centre = np.concatenate([self.chain.centre, centres[self.free]])
        self.widths = np.concatenate([self.chain.widths, widths[self.free]])
        # a prior may lie far from what was simulated, and its centre must be reached
        self.longest = np.maximum(self.widths, np.abs(self.centre - self.vector()))
        self.reach = np.array([nuisance.reach for nuisance in chosen])
        self.names = tuple(nuisance.name for nuisance in chosen)
        bounds = [n.bounds(physics.nominal(n)) for n in chosen]
        low, high = np.reshape(bounds, (len(chosen), 2)).T
        self.low = np.concatenate([self.chain.low, low])
        self.high = np.concatenate([self.chain.high, high])

    def vector(self) -> Values:
        """Current values of all parameters as one vector."""
        return np.concatenate([self.chain.vector(), self.coordinates[self.free]])

    def set(self, vector: Values) -> None:
        """Set all parameters from a vector. Coordinates are limited to their bounds."""
        self.chain.set(vector[: self.n_chain])
        self.coordinates = self.coordinates.copy()
        n = self.n_chain
        self.coordinates[self.free] = np.clip(vector[n:], self.low[n:], self.high[n:])


@dataclass(eq=False)
class JointProblem:
    r"""Residuals of functions in slices of drift time, of priors and of further knowledge.

    For each band of energies the mean functions of simulation and data are compared,

    .. math:: \chi^2 = \mathbf{d}^T C^{-1} \mathbf{d}
        + \sum_i \frac{(x_i - \mu_i)^2}{\sigma_i^2}, \qquad
        \mathbf{d} = \langle \mathbf{f} \rangle_{\mathrm{sim}}
        - \langle \mathbf{f} \rangle_{\mathrm{data}},

    where :math:`C` is the mean covariance of both sides divided by the number of pulses, with
    correlations shrunk towards zero by `RIDGE`, and :math:`\mu_i \pm \sigma_i` are the priors.

    Parameters
    ----------
    parameters
        Parameters to be fitted.
    bands
        Bands of energies to compare. Of their simulated pulses only rows, noise and weights
        are used.
    functions
        Functions of each band.
    nearby
        Pulses near a point of the physics.
    recipe
        Recipe with the preparation of simulated pulses.
    known
        Deviations from further knowledge of the coordinates, in standard deviations.
    held
        Whether steps beyond the reach of the derivatives are penalised. This is for the first
        steps from far away, where the variation of simulated pulses says nothing about errors.
    """

    parameters: JointParameters
    bands: Sequence[Band]
    functions: Sequence[SlicedFunctions]
    nearby: Nearby
    recipe: Recipe
    known: Callable[[Values], Values] = lambda _: np.empty(0)
    held: bool = False
    # Number of events for derivatives; None for all. At a minimum, the derivatives must be
    # those of the residuals: along weak directions the sampling error of some of the events is
    # as large as the derivative itself.
    few: int | None = field(init=False)

    def __post_init__(self) -> None:
        self.few = fewest(self.bands) if self.held else None
        self._placed: tuple[Nearby, npt.NDArray[np.int64]] | None = None
        self._translated: dict[int | None, tuple[Nearby, Values, list[SimulatedSide]]] = {}
        self._weigh(None)

    @property
    def clip(self) -> float | None:
        """Number of standard deviations at which the functions are clipped."""
        return self._clip

    @clip.setter
    def clip(self, clip: float | None) -> None:
        if clip != self._clip:
            self._weigh(clip)

    def _weigh(self, clip: float | None) -> None:
        """Set the clip, and errors and correlations of the functions with it."""
        self._clip = clip
        self._wanted, self._sigma, self._whiten, self._counted = [], [], [], []
        for band, functions in zip(self.bands, self.functions, strict=True):
            values = functions(band.moments.data, clip)
            covariance = np.cov(values.T) / band.pairs
            if not self.held:
                # both sides: weights that follow fluctuations of one would bias the fit to it
                simulated = self._covariance(band, functions) / band.pairs
                covariance = 0.5 * (covariance + simulated)
            sigma = np.maximum(np.sqrt(covariance.diagonal()), 1e-12)
            correlation = covariance / sigma[:, np.newaxis] / sigma
            variances = np.maximum(np.linalg.eigvalsh(correlation), 0)
            correlation = (1 - RIDGE) * correlation + RIDGE * np.eye(len(sigma))
            self._counted.append(variances / ((1 - RIDGE) * variances + RIDGE))
            self._wanted.append(values.mean(axis=0))
            self._sigma.append(sigma)
            self._whiten.append(scipy.linalg.cholesky(np.linalg.inv(correlation)))

    @property
    def moments(self) -> int:
        """Number of compared functions in all bands."""
        return sum(len(sigma) for sigma in self._sigma)

    @property
    def by_chance(self) -> tuple[float, float]:
        r"""Mean and standard deviation of chi-square if simulation and data agree.

        The ridge makes directions in which the functions hardly vary count for little. With the
        eigenvalues :math:`\lambda` of the correlation matrix and the ridge :math:`\rho`, each
        contributes :math:`q = \lambda / [(1 - \rho) \lambda + \rho]` instead of 1, so the mean
        is :math:`\sum q` and the variance :math:`2 \sum q^2`.
        """
        counted = np.concatenate(self._counted)
        return float(counted.sum()), float(np.sqrt(2 * counted @ counted))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the functions, with their band if there are several."""
        several = len(self.bands) > 1
        return tuple(
            f"{band.name}: {name}" if several else name
            for band, functions in zip(self.bands, self.functions, strict=True)
            for name in functions.names
        )

    def pulls(self) -> Values:
        """Deviations of the functions in standard deviations; they are correlated."""
        return np.concatenate(self._pulls(self.parameters.vector()))

    def chi_square(self) -> float:
        r""":math:`\mathbf{d}^T C^{-1} \mathbf{d}` of the functions alone, without priors."""
        deviations = self._deviations(self.parameters.vector())
        return float(deviations @ deviations)

    def of_chain(self, response: ElectronicsResponse) -> JointProblem:
        """The same comparison, weights included, for another chain and fixed physics."""
        physics, own = self.nearby.simulator.physics, self.parameters
        parameters = JointParameters(
            response, physics, own.coordinates, [], own.given, own.start
        )
        other = replace(self, parameters=parameters, known=lambda _: np.empty(0), held=True)
        other.held, other.few = False, None  # held ones need no weights of their own
        other.weigh_like(self)
        return other

    def of_bands(self, bands: Sequence[Band]) -> JointProblem:
        """The same comparison, weights included, of parts of these bands, wholly used."""
        part = replace(self, bands=bands, held=True)  # held ones need no weights of their own
        part.few = None
        part.weigh_like(self)
        return part

    def weigh_like(self, other: JointProblem) -> None:
        """Adopt errors and correlations of the same functions from another problem."""
        self._sigma, self._whiten = other._sigma, other._whiten
        self._counted = other._counted

    def residuals(self, vector: Values) -> Values:
        """Uncorrelated deviations of the functions, priors and further knowledge.

        While steps are held, accuracy matters less and only some of the pulses are used.
        """
        parameters = self.parameters
        prior = (vector - parameters.centre) / parameters.widths
        deviations = self._deviations(vector, self.few if self.held else None)
        rows = [deviations, prior, self.known(parameters.coordinates)]
        if self.held:
            moved = (parameters.coordinates - self.nearby.centre)[parameters.free]
            rows.append(HOLD * moved / parameters.reach)
        return np.concatenate(rows)

    def jacobian(self, vector: Values) -> Values:
        """Derivatives of all residuals, shape (residuals, parameters).

        If `few` is set, they are of that many pulses and one draw of noise.
        """
        parameters = self.parameters
        parameters.set(vector)
        rows = [*self._slopes(), np.diag(1 / parameters.widths)]
        n, at, physics = parameters.n_chain, parameters.coordinates, []
        for i, step in zip(parameters.free, STEP * parameters.reach, strict=True):
            there = at + step * np.eye(len(at))[i]
            physics.append((self.known(there) - self.known(at)) / step)
        columns = np.reshape(physics, (len(physics), len(self.known(at)))).T
        if self.held:
            columns = np.concatenate([columns, np.diag(HOLD / parameters.reach)])
        rows.append(np.pad(columns, ((0, 0), (n, 0))))
        return np.concatenate(rows)

    def _slopes(self) -> list[Values]:
        """Derivatives of the uncorrelated deviations of each band."""
        parameters, at = self.parameters, self.parameters.coordinates
        windows, found = self._entering(at), []
        steps = (STEP * parameters.reach).astype(np.float32)
        changes = [
            (self._entering(at + step * np.eye(len(at))[i]) - windows) / step
            for i, step in zip(parameters.free, steps, strict=True)
        ]
        for k, side in enumerate(self._simulated(at, self.few)):
            records = ways(parameters.chain, side)

            def of_pulses(
                rows: slice,
                of_chain: OfPulses = records.of_pulses,
                band: Rows = self.bands[k].rows,
            ) -> FloatArray:
                own = [change[band[rows]][np.newaxis] for change in changes]
                return np.concatenate([of_chain(rows), *own])

            mean = DifferentiableSet(side).slopes(
                records._replace(of_pulses=of_pulses),
                partial(self.functions[k], clip=self._clip),
                draws=None if self.few is None else 1,
            )
            found.append(self._whiten[k] @ (mean.T / self._sigma[k]).T)
        return found

    def _entering(self, coordinates: Values) -> FloatArray:
        """Simulated pulses of some events at some coordinates as they enter the readout."""
        windows = self.windows(coordinates, self.few)
        return self.parameters.chain.response.drifted(windows)

    def windows(self, coordinates: Values, most: int | None = None) -> FloatArray:
        """Prepared simulated pulses of the first `most` events, as input of a readout.

        Their windows are those of the centre.  Noise begins with a window: if windows followed
        the pulses, by whole samples, every step would give some pulses other noise.
        """
        if self._placed is None or self._placed[0] is not self.nearby:
            self._placed = self.nearby, self._starts()
        preparation = self.recipe.preparation
        length = preparation.samples_before + preparation.samples_after
        windows: FloatArray = cut(self.nearby.at(coordinates, most), self._placed[1], length)
        return windows

    def _starts(self) -> npt.NDArray[np.int64]:
        """Sample of each pulse at the centre with which its window begins."""
        base, preparation = self.nearby.base, self.recipe.preparation
        pulses = Pulses.of(base, dt_ns=self.nearby.simulator.physics.settings.dt_ns)
        prepared = prepare(pulses, preparation, "simulated")
        if len(prepared) < len(base):
            told = ", ".join(f"{n} {reason}" for reason, n in prepared.rejections.items())
            raise CpunetError(
                f"with these physics {len(base) - len(prepared)} of {len(base)} events "
                f"give no pulse ({told}); narrow the `prior` of what is free"
            )
        return prepared.align_sample - preparation.samples_before

    def _covariance(self, band: Band, functions: SlicedFunctions) -> Values:
        """Covariance of the functions over the simulated pulses of a band."""
        some = band.sim.of(slice(FOR_COVARIANCE))
        waveforms = self.windows(self.nearby.centre)[band.rows[: len(some)]]

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
        """Deviations of the functions of each band, from the first `most` events."""
        parameters = self.parameters
        parameters.set(vector)
        simulated = self._simulated(parameters.coordinates, most)
        draws = None if most is None else 1
        found = []
        for i, (translated, functions) in enumerate(
            zip(simulated, self.functions, strict=True)
        ):

            def of(readings: Readings, functions: SlicedFunctions = functions) -> tuple[Values]:
                return (readings.weights @ functions(readings, self._clip),)

            # far from the data many tails exceed theirs, and none may be left out
            (total,), n = translated.sums(
                parameters.chain.response, of, cut=self._clip is None, draws=draws
            )
            found.append((total / max(n, 1e-9) - self._wanted[i]) / self._sigma[i])
        return found

    def _simulated(self, coordinates: Values, most: int | None) -> list[SimulatedSide]:
        """Pulses of each band at some coordinates, from the first `most` events.

        The last ones are kept: their preparation and Fourier transform take longer than a
        chain, and derivatives use the same.
        """
        kept = self._translated.get(most)
        if kept is not None:
            nearby, where, translated = kept
            if nearby is self.nearby and np.array_equal(where, coordinates):
                return translated
        waveforms = self.windows(coordinates, most)
        translated = []
        for band in self.bands:
            n_rows = len(band.rows) if most is None else np.searchsorted(band.rows, most)
            some = band.sim.of(slice(int(n_rows)))
            translated.append(replace(some, sim=waveforms[band.rows[: len(some)]]))
        self._translated[most] = self.nearby, coordinates.copy(), translated
        return translated


def fewest(bands: Sequence[Band], most: int = FOR_DERIVATIVES) -> int:
    """Number of first events sufficient for derivatives, with some of each band."""
    return max(most, *(int(band.rows[:OF_BAND][-1]) + 1 for band in bands))
