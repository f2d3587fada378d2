"""The comparison of simulation and data that chain and physics minimise together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from cpunet.calibration.nearby import FloatArray, Nearby, cut
from cpunet.calibration.nuisances import Physics, Values
from cpunet.calibration.sliced_functions import SlicedJoint
from cpunet.errors import CpunetError
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import Recipe
from cpunet.training.aligned import Basis
from cpunet.training.chain_fit import Parabola, minimum
from cpunet.training.chain_parameters import SmoothParameters
from cpunet.training.comparison import NONE, Difference
from cpunet.training.joint import SHRUNK

# Residual that keeps a step within the reach of the derivatives: its size at the reach.
HOLD = 4.0
# Number of events for derivatives while steps are held, and minimum number of each band.
FOR_DERIVATIVES, OF_BAND = 1536, 100
# Step in the physics, in which pulses are linear, as a fraction of the reach of a derivative.
STEP = 0.1
STEPS, FALL = 12, 0.2  # most of a fit; expected fall of chi-square with which it ends


class JointParameters:
    """Parameters of the chain and free coordinates of the physics as a vector.

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
        depend on where the first fit ended.
    modes
        Deviations of the step response that are free, with priors of 0 ± 1, if the response
        has any.
    """

    def __init__(
        self,
        response: ElectronicsResponse,
        physics: Physics,
        coordinates: Values,
        free: Sequence[int],
        given: Mapping[str, tuple[float, float]],
        start: ElectronicsResponse,
        modes: Values = NONE,
    ) -> None:
        self.chain, self.given, self.start = SmoothParameters(response, start), given, start
        self.coordinates, self.free = coordinates.copy(), list(free)
        self.modes = modes
        self.along: Values = np.empty(0)
        if response.config.deviations:
            self.along = np.asarray(np.linalg.lstsq(modes, response.deviation)[0])
        n_modes = len(self.along)
        self.n_chain = len(self.chain.labels) + n_modes
        chosen = [physics.nuisances[i] for i in self.free]
        centres, widths = physics.priors(given)
        self.centre = np.r_[self.chain.centre, np.zeros(n_modes), centres[self.free]]
        self.widths = np.r_[self.chain.widths, np.ones(n_modes), widths[self.free]]
        # a prior may lie far from what was simulated, and its centre must be reached
        self.longest = np.maximum(self.widths, np.abs(self.centre - self.vector()))
        self.reach = np.array([nuisance.reach for nuisance in chosen])
        self.names = tuple(nuisance.name for nuisance in chosen)
        bounds = [n.bounds(physics.nominal(n)) for n in chosen]
        low, high = np.reshape(bounds, (len(chosen), 2)).T
        unlimited = np.full(n_modes, np.inf)
        self.low = np.r_[self.chain.low, -unlimited, low]
        self.high = np.r_[self.chain.high, unlimited, high]

    def vector(self) -> Values:
        """Current values of all parameters as a vector."""
        free = self.coordinates[self.free]
        return np.concatenate([self.chain.vector(), self.along, free])

    def set(self, vector: Values) -> None:
        """Set all parameters from a vector. Coordinates are limited to their bounds."""
        n, own = self.n_chain, len(self.chain.labels)
        self.chain.set(vector[:own])
        self.along = vector[own:n].copy()
        if len(self.along):
            self.chain.response.set_deviation(self.modes @ self.along)
        self.coordinates = self.coordinates.copy()
        self.coordinates[self.free] = np.clip(vector[n:], self.low[n:], self.high[n:])

    def basis(self, padded: int) -> Basis:
        """Changes of the step response with each parameter of the readout."""
        basis = self.chain.basis(padded)
        if not len(self.along):
            return basis
        return Basis(basis.first, np.column_stack([basis.changes, self.modes]))


@dataclass(eq=False)
class JointProblem:
    r"""Residuals of functions in slices of drift time, of priors and of further knowledge.

    For each band of energies the mean functions of simulation and data are compared,

    .. math:: \chi^2 = \mathbf{d}^T C^{-1} \mathbf{d}
        + \sum_i \frac{(x_i - \mu_i)^2}{\sigma_i^2}, \qquad
        \mathbf{d} = \langle \mathbf{f} \rangle_{\mathrm{sim}}
        - \langle \mathbf{f} \rangle_{\mathrm{data}},

    where :math:`C` is the covariance of `cpunet.training.joint`, at the start of the problem,
    and :math:`\mu_i \pm \sigma_i` are the priors.

    Parameters
    ----------
    parameters
        Parameters to be fitted.
    functions
        Functions of each band of energies, with its pulses.  Of the simulated ones only rows
        and noise are used.
    nearby
        Pulses near a point of the physics.
    recipe
        Recipe with the preparation of simulated pulses.
    knowledge
        Deviations from further knowledge of the coordinates, in standard deviations.
    held
        Whether steps beyond the reach of the derivatives are penalised. This is for the first
        steps from far away, where the variation of simulated pulses says nothing about errors.
    weights
        Covariances of another problem with the same functions, to be adopted.
    """

    parameters: JointParameters
    functions: Sequence[SlicedJoint]
    nearby: Nearby
    recipe: Recipe
    knowledge: Callable[[Values], Values] = lambda _: np.empty(0)
    held: bool = False
    weights: Sequence[Values] = ()
    _roots: list[Values] = field(init=False)

    def __post_init__(self) -> None:
        base, preparation = self.nearby.base, self.recipe.preparation
        pulses = Pulses.of(base, dt_ns=self.nearby.simulator.physics.settings.dt_ns)
        prepared = prepare(pulses, preparation, "simulated")
        if len(prepared) < len(base):
            counts = ", ".join(f"{n} {reason}" for reason, n in prepared.rejections.items())
            raise CpunetError(
                f"with these physics {len(base) - len(prepared)} of {len(base)} events "
                f"give no pulse ({counts}); narrow the `prior` of what is free"
            )
        self._first = prepared.align_sample - preparation.samples_before
        if not self.weights:
            self.weights = (
                [functions.covariance(np.cov(functions.data.T)) for functions in self.functions]
                if self.held
                else [difference.covariance for difference in self._differences()]
            )
        self._roots = [np.asarray(np.linalg.cholesky(of)) for of in self.weights]

    @property
    def moments(self) -> int:
        """Number of compared functions in all bands."""
        return sum(len(root) for root in self._roots)

    @property
    def names(self) -> dict[str, list[str]]:
        """Names of the functions by group."""
        return {of: own for functions in self.functions for of, own in functions.names.items()}

    @property
    def by_chance(self) -> tuple[float, float]:
        r"""Mean and standard deviation of chi-square if simulation and data agree.

        The diagonal in the covariance makes directions in which the functions hardly vary count
        for little.  With the eigenvalues :math:`\lambda` of the correlation matrix with a share
        :math:`\rho` of the identity, each contributes
        :math:`q = (1 - \rho / \lambda) / (1 - \rho)` instead of 1, so the mean is
        :math:`\sum q` and the variance :math:`2 \sum q^2`.
        """
        counted = []
        for weights in self.weights:
            sigma = np.sqrt(weights.diagonal())
            sizes = np.linalg.eigvalsh(weights / np.outer(sigma, sigma))
            counted.append(np.maximum(1 - SHRUNK / sizes, 0) / (1 - SHRUNK))
        each = np.concatenate(counted)
        return float(each.sum()), float(np.sqrt(2 * each @ each))

    def compared(self) -> tuple[float, Values]:
        r"""Chi-square :math:`\mathbf{d}^T C^{-1} \mathbf{d}` without priors, and pulls.

        Pulls are deviations of the functions in standard deviations; they are correlated.
        """
        differences = self._differences()
        deviations = self._stacked(self.parameters.vector(), differences)[: self.moments]
        pulls = [
            difference.values / np.sqrt(weights.diagonal())
            for difference, weights in zip(differences, self.weights, strict=True)
        ]
        return float(deviations @ deviations), np.concatenate(pulls)

    def fitted(self, count: Callable[[float], None] = lambda _: None) -> Parabola:
        """Set the parameters to the minimum."""
        return minimum(self.parameters, self._parabola, STEPS, FALL, count)

    def _parabola(self, place: Values) -> Parabola:
        residuals, jacobian, _ = self.both(place)
        own = np.r_[: self.moments, self.moments + len(place) : len(residuals)]  # no priors
        chi_square = float(residuals[: self.moments] @ residuals[: self.moments])
        return Parabola(
            place,
            chi_square,
            self.moments,
            jacobian[own].T @ jacobian[own],
            float(residuals @ residuals),
            jacobian.T @ residuals,
        )

    def residuals(self, vector: Values) -> Values:
        """Uncorrelated deviations of the functions, priors and further knowledge."""
        self.parameters.set(vector)
        return self._stacked(vector, self._differences())

    def both(self, vector: Values) -> tuple[Values, Values, tuple[Values, Values]]:
        """Residuals, their derivatives, and both of parts of the events.

        Shapes are (residuals,), (residuals, parameters), (parts, functions, parameters), and
        (parts, functions).
        """
        parameters = self.parameters
        parameters.set(vector)
        differences = self._differences(slopes=True)
        white = []
        for root, difference in zip(self._roots, differences, strict=True):
            assert difference.parts is not None
            slopes, values = difference.parts
            both = np.moveaxis(np.concatenate([slopes, values[..., np.newaxis]], axis=2), 1, 0)
            flat = both.reshape(len(root), -1)
            white.append(_white(root, flat).reshape(both.shape))
        parts = np.concatenate(white).swapaxes(0, 1)  # (parts, functions, parameters + 1)
        slopes, values = parts[..., :-1], parts[..., -1]
        rows = [slopes.mean(axis=0), np.diag(1 / parameters.widths)]
        at, physics = parameters.coordinates, []
        for i, step in zip(parameters.free, STEP * parameters.reach, strict=True):
            moved = at + step * np.eye(len(at))[i]
            physics.append((self.knowledge(moved) - self.knowledge(at)) / step)
        columns = np.reshape(physics, (len(physics), len(self.knowledge(at)))).T
        if self.held:
            columns = np.concatenate([columns, np.diag(HOLD / parameters.reach)])
        rows.append(np.pad(columns, ((0, 0), (parameters.n_chain, 0))))
        return self._stacked(vector, differences), np.concatenate(rows), (slopes, values)

    def _stacked(self, vector: Values, differences: Sequence[Difference]) -> Values:
        parameters = self.parameters
        rows = [
            *(_white(of, d.values) for of, d in zip(self._roots, differences, strict=True)),
            (vector - parameters.centre) / parameters.widths,
            self.knowledge(parameters.coordinates),
        ]
        if self.held:
            moved = (parameters.coordinates - self.nearby.centre)[parameters.free]
            rows.append(HOLD * moved / parameters.reach)
        return np.concatenate(rows)

    def _differences(self, *, slopes: bool = False) -> list[Difference]:
        """Differences of each band at the current parameters, with derivatives if asked."""
        parameters, at = self.parameters, self.parameters.coordinates
        padded = self.functions[0].sides.padded
        transfer = parameters.chain.response.transfer(padded)
        if not slopes:
            return [functions.difference(transfer) for functions in self.here()]
        most, steps = events(self.functions), STEP * parameters.reach
        windows = self.windows(at, most)
        changes = [
            (self.windows(at + step * np.eye(len(at))[i], most) - windows) / np.float32(step)
            for i, step in zip(parameters.free, steps, strict=True)
        ]
        basis, differences = parameters.basis(padded), []
        for functions in self.here():
            own = [each[functions.sides.rows] for each in changes]
            differences.append(functions.difference(transfer, basis, own))
        return differences

    def here(self) -> list[SlicedJoint]:
        """Functions with the simulated pulses at the current coordinates."""
        windows = self.windows(self.parameters.coordinates, events(self.functions))
        return [functions.taking(windows[functions.sides.rows]) for functions in self.functions]

    def windows(self, coordinates: Values, most: int | None = None) -> FloatArray:
        """Prepared simulated pulses of the first `most` events, as input of a readout.

        Their windows are those of the centre.  Noise begins with a window: if windows followed
        the pulses, by whole samples, every step would give some pulses other noise.
        """
        length = self.recipe.preparation.length
        windows: FloatArray = cut(self.nearby.at(coordinates, most), self._first, length)
        return windows


def _white(root: Values, values: Values) -> Values:
    """Values without their correlations, given the root of the covariance."""
    return np.asarray(scipy.linalg.solve_triangular(root, values, lower=True))


def events(functions: Sequence[SlicedJoint]) -> int:
    """Number of first events of which these are functions."""
    return 1 + max(int(band.sides.rows.max()) for band in functions)


def first(functions: Sequence[SlicedJoint], most: int = FOR_DERIVATIVES) -> list[SlicedJoint]:
    """Functions of the first events, sufficient for derivatives, with some of each band."""
    most = max(most, *(int(np.sort(band.sides.rows)[:OF_BAND][-1]) + 1 for band in functions))
    return [band.with_sides(band.sides.of_events(band.sides.rows < most)) for band in functions]
