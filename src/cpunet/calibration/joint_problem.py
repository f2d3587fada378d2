r"""The comparison of simulation and data that chain and physics minimise together.

The first principal component of aligned pulses is how early their charge begins to move: their
drift time :math:`t`.  Velocities and impurities change its density, above all at its end.  The
other components :math:`c_i` and the current amplitude :math:`A` are evaluated in slices of the
drift time: what depends on it, such as the growth of the charge cloud, is thus distinguished
from what does not, the readout.  With Gaussian bins :math:`g_k` the functions are those of
`cpunet.training.joint`, :math:`g_k(t)`, :math:`c_i\, g_k(t)`, and
:math:`g_j(\ln A)\, g_k(t)`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import scipy.linalg

from cpunet.calibration.nearby import FloatArray, Nearby
from cpunet.calibration.nuisances import Values
from cpunet.errors import CpunetError
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import Recipe
from cpunet.training.aligned import Aligned, Floats, stretch
from cpunet.training.chain_fit import Parabola, SmoothParameters, minimum
from cpunet.training.comparison import NONE, Difference
from cpunet.training.joint import SEGMENTS, SHRUNK, Joint, gaussian_bins
from cpunet.training.pulse_sets import Sides

# Residual that keeps a step within the reach of the derivatives: its size at the reach.
HOLD = 4.0
# Number of events for derivatives while steps are held, and minimum number of each band.
FOR_DERIVATIVES, OF_BAND = 1536, 100
# Step in the physics, in which pulses are linear, as a fraction of the reach of a derivative.
STEP = 0.1
STEPS, FALL = 12, 0.2  # most of a fit; expected fall of chi-square with which it ends
# Bins of the drift time, its slices, and bins of the current amplitude in each: number (half as
# many for few pulses), ranks of the first and the last, width in units of the spacing, and
# minimum width, twice the effect of noise.
DENSITY = (24, (0.01, 0.99), 1.0, 0.02)
SLICES = (8, (0.03, 0.97), 0.8, 0.05)
AMPLITUDES = (8, (0.05, 0.98), 1.0, 0.008)
OTHERS, FEW = 6, 700  # components in each slice; few pulses
# Values without their correlations, given the root of the covariance.
_white = partial(scipy.linalg.solve_triangular, lower=True)


class SlicedJoint(Joint):
    """Differences of both sides in slices of drift time, for any response.

    Parameters
    ----------
    sides, wider
        See `cpunet.training.joint.Joint`.
    band
        Energies of the pulses, if these are several bands.
    """

    def __init__(self, sides: Sides, wider: float = 1.0, band: str = "") -> None:
        super().__init__(sides, wider)
        self.band = band
        drift = self._shape(sides.data)[:, -1]
        amplitude, parts = sides.data.log_amplitude, 2 if len(drift) < FEW else 1
        self._bands = []
        for values, (n, ranks, factor, least) in (
            (drift, DENSITY),
            (drift, SLICES),
            (amplitude, AMPLITUDES),
        ):
            centres = np.quantile(values, np.linspace(*ranks, n // parts))
            gaps = np.diff(centres)
            # the density ends abruptly at the longest drift times
            between = np.concatenate([gaps[:1], np.minimum(gaps[1:], gaps[:-1]), gaps[-1:]])
            self._bands.append((centres, wider * np.maximum(factor * between, least)))

    @property
    def groups(self) -> dict[str, int]:
        """Numbers of functions by group, in order; names begin with the band of several."""
        components, bins = self.matrix.shape[1] - SEGMENTS, len(self.places)
        times, slices, amplitudes = (len(centres) for centres, _ in self._bands)
        numbers = {
            "samples": SEGMENTS,
            "components": components,
            "current amplitude": bins,
            "components with current amplitude": components * bins * self.products,
            "drift time": times,
            "components in slices": OTHERS * slices,
            "current amplitude in slices": amplitudes * slices,
        }
        band = f"{self.band}: " if self.band else ""
        return {f"{band}{group}": number for group, number in numbers.items() if number}

    def _functions(self, pulses: Aligned) -> Values:
        shape = self._shape(pulses)
        (density, _), (slices, _), (amplitudes, _) = self._sliced(shape, pulses)
        columns = [super()._functions(pulses), density]
        for values in (shape[:, -2 : -2 - OTHERS : -1], amplitudes):
            products = values[:, :, np.newaxis] * slices[:, np.newaxis]
            columns.append(products.reshape(len(shape), -1))
        return np.concatenate(columns, axis=1)

    def _slopes(self, pulses: Aligned, changes: Floats, of_log: Floats) -> Values:
        shape, (n, coordinates) = self._shape(pulses), of_log.shape
        (_, density), (slices, sliding), (amplitudes, turned) = self._sliced(shape, pulses)
        drift, others = changes[:, -1], slice(-2, -2 - OTHERS, -1)
        slopes = [n * super()._slopes(pulses, changes, of_log), density.T @ drift]
        moved = (turned[:, :, np.newaxis] * of_log[:, np.newaxis]).reshape(n, -1)
        for values, own in (
            (shape[:, others], changes[:, others].reshape(n, -1)),
            (amplitudes, moved),
        ):
            along = (values[:, :, np.newaxis] * drift[:, np.newaxis]).reshape(n, -1)
            each = slices.T @ own + sliding.T @ along  # (slices, values * coordinates)
            each = each.reshape(len(each), -1, coordinates).swapaxes(0, 1)
            slopes.append(each.reshape(-1, coordinates))
        return np.asarray(np.concatenate(slopes) / n)

    def _sliced(self, shape: Values, pulses: Aligned) -> list[tuple[Values, Values]]:
        """Bins of density, slices of drift time, and bins of the amplitude in these."""
        drift = shape[:, -1]
        own = (drift, drift, pulses.log_amplitude)
        return [gaussian_bins(of, *band) for of, band in zip(own, self._bands, strict=True)]


@dataclass(eq=False)
class JointProblem:
    r"""Residuals of functions in slices of drift time, of priors and of further knowledge.

    For each band of energies the mean functions of simulation and data are compared,

    .. math:: \chi^2 = \mathbf{d}^T C^{-1} \mathbf{d}
        + \sum_i \frac{(x_i - \mu_i)^2}{\sigma_i^2}, \qquad
        \mathbf{d} = \langle \mathbf{f} \rangle_{\mathrm{sim}}
        - \langle \mathbf{f} \rangle_{\mathrm{data}},

    where :math:`C` is the covariance of `cpunet.training.joint.Joint`, at the start of
    the problem, and :math:`\mu_i \pm \sigma_i` are the priors.  Parameters of the chain,
    deviations of its step response and free coordinates of the physics are a vector, in this
    order.

    Parameters
    ----------
    response
        The chain, a copy of which is changed.
    nearby
        Pulses near a point of the physics.
    free
        Positions of the free coordinates.
    functions
        Functions of each band of energies, with its pulses.  Of the simulated ones only rows
        and noise are used.
    recipe
        Recipe with the preparation of simulated pulses.
    start
        The chain before any fit, on which the priors of the same parameters are centred; those
        of others on their current values. Centred on the last fit, they would make a result
        depend on where the first fit ended.
    modes
        Deviations of the step response that are free, with priors of 0 ± 1, if the response
        has any.
    knowledge
        Deviations from further knowledge of the coordinates, in standard deviations.
    held
        Whether steps beyond the reach of the derivatives are penalised. This is for the first
        steps from far away, where the variation of simulated pulses says nothing about errors.
    coordinates
        Coordinates of the physics; by default those of the point.
    weights
        Covariances of another problem with the same functions, to be adopted.
    """

    response: ElectronicsResponse
    nearby: Nearby
    free: list[int]
    functions: Sequence[SlicedJoint]
    recipe: Recipe
    start: ElectronicsResponse
    modes: Values = field(default_factory=lambda: NONE)
    knowledge: Callable[[Values], Values] = lambda _: np.empty(0)
    held: bool = False
    coordinates: Values = field(default_factory=lambda: NONE)
    weights: Sequence[Values] = ()

    def __post_init__(self) -> None:
        # the vector: its priors, bounds and longest steps
        self.physics = self.nearby.simulator.physics
        self.response = copy.deepcopy(self.response)
        if not len(self.coordinates):
            self.coordinates = self.nearby.centre
        self.chain = SmoothParameters(self.response, self.start)
        self.along: Values = np.empty(0)
        if self.response.config.deviations:
            self.along = np.asarray(np.linalg.lstsq(self.modes, self.response.deviation)[0])
        n_modes = len(self.along)
        self.n_chain = len(self.chain.labels) + n_modes
        chosen = [self.physics.nuisances[i] for i in self.free]
        centres, widths = self.physics.priors()
        self.centre = np.r_[self.chain.centre, np.zeros(n_modes), centres[self.free]]
        self.widths = np.r_[self.chain.widths, np.ones(n_modes), widths[self.free]]
        # a prior may lie far from what was simulated, and its centre must be reached
        self.longest = np.maximum(self.widths, np.abs(self.centre - self.vector()))
        self.reach = np.array([nuisance.reach for nuisance in chosen])
        bounds = [n.bounds(self.physics.nominal(n)) for n in chosen]
        low, high = np.reshape(bounds, (len(chosen), 2)).T
        unlimited = np.full(n_modes, np.inf)
        self.low = np.r_[self.chain.low, -unlimited, low]
        self.high = np.r_[self.chain.high, unlimited, high]
        # windows of the pulses, and the covariances
        base, preparation = self.nearby.base, self.recipe.preparation
        pulses = Pulses.of(base, dt_ns=self.physics.settings.dt_ns)
        prepared = prepare(pulses, preparation, "simulated")
        if len(prepared) < len(base):
            counts = ", ".join(f"{n} {reason}" for reason, n in prepared.rejections.items())
            raise CpunetError(
                f"with these physics {len(base) - len(prepared)} of {len(base)} events "
                f"give no pulse ({counts}); narrow the `prior` of what is free"
            )
        self._begin = prepared.align_sample - preparation.samples_before
        if not self.weights and self.held:
            self.weights = [of.covariance(np.cov(of.data.T)) for of in self.functions]
        elif not self.weights:
            self.weights = [difference.covariance for difference in self._differences()]
        self._roots = [np.asarray(np.linalg.cholesky(of)) for of in self.weights]
        self.moments, self.errors = sum(map(len, self.weights)), np.zeros(len(self.free))

    def vector(self) -> Values:
        """Current values of all parameters as a vector."""
        return np.concatenate([self.chain.vector(), self.along, self.coordinates[self.free]])

    def set(self, vector: Values) -> None:
        """Set all parameters from a vector. Coordinates are limited to their bounds."""
        n, own = self.n_chain, len(self.chain.labels)
        self.chain.set(vector[:own])
        self.along = vector[own:n].copy()
        if len(self.along):
            self.response.deviation[:] = self.modes @ self.along
        self.coordinates = self.coordinates.copy()
        self.coordinates[self.free] = np.clip(vector[n:], self.low[n:], self.high[n:])

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
        deviations = self.residuals(self.vector(), differences)[: self.moments]
        pulls = [
            difference.values / np.sqrt(weights.diagonal())
            for difference, weights in zip(differences, self.weights, strict=True)
        ]
        return float(deviations @ deviations), np.concatenate(pulls)

    def fitted(self) -> Parabola:
        """Set the parameters to the minimum, and the errors of the free coordinates there."""

        def parabola(place: Values) -> Parabola:
            residuals, jacobian, _ = self.both(place)
            off = residuals[: self.moments]
            own = np.r_[: self.moments, self.moments + len(place) : len(residuals)]  # no priors
            return Parabola(
                place,
                float(off @ off),
                self.moments,
                jacobian[own].T @ jacobian[own],
                float(residuals @ residuals),
                jacobian.T @ residuals,
            )

        end = minimum(self, parabola, STEPS, FALL, lambda _: None)
        covariance = np.linalg.inv(end.information + np.diag(self.widths**-2.0))
        self.errors = np.sqrt(covariance.diagonal())[self.n_chain :]
        return end

    def residuals(
        self, vector: Values, differences: Sequence[Difference] | None = None
    ) -> Values:
        """Uncorrelated deviations of the functions, priors and further knowledge.

        Where the differences are given, the parameters are those of the vector already.
        """
        if differences is None:
            self.set(vector)
            differences = self._differences()
        rows = [
            *(_white(of, d.values) for of, d in zip(self._roots, differences, strict=True)),
            (vector - self.centre) / self.widths,
            self.knowledge(self.coordinates),
        ]
        if self.held:
            moved = (self.coordinates - self.nearby.centre)[self.free]
            rows.append(HOLD * moved / self.reach)
        return np.concatenate(rows)

    def both(self, vector: Values) -> tuple[Values, Values, tuple[Values, Values]]:
        """Residuals, their derivatives, and both of parts of the events.

        Shapes are (residuals,), (residuals, parameters), (parts, functions, parameters), and
        (parts, functions).
        """
        self.set(vector)
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
        rows = [slopes.mean(axis=0), np.diag(1 / self.widths)]
        at, physics = self.coordinates, []
        for i, step in zip(self.free, STEP * self.reach, strict=True):
            moved = at + step * np.eye(len(at))[i]
            physics.append((self.knowledge(moved) - self.knowledge(at)) / step)
        columns = np.reshape(physics, (len(physics), len(self.knowledge(at)))).T
        if self.held:
            columns = np.concatenate([columns, np.diag(HOLD / self.reach)])
        rows.append(np.pad(columns, ((0, 0), (self.n_chain, 0))))
        return self.residuals(vector, differences), np.concatenate(rows), (slopes, values)

    def _differences(self, *, slopes: bool = False) -> list[Difference]:
        """Differences of each band at the current parameters, with derivatives if asked."""
        at = self.coordinates
        padded, basis, changes = self.functions[0].sides.padded, None, list[FloatArray]()
        transfer = self.response.transfer(padded)
        if slopes:
            most, steps = events(self.functions), STEP * self.reach
            windows = self.windows(at, most)
            for i, step in zip(self.free, steps, strict=True):
                moved = self.windows(at + step * np.eye(len(at))[i], most)
                changes.append((moved - windows) / np.float32(step))
            basis = self.chain.basis(padded)
            if len(self.along):
                basis = np.column_stack([basis, self.modes])
        differences = []
        for functions in self.here():
            own = [each[functions.sides.rows] for each in changes]
            differences.append(functions.difference(transfer, basis, own))
        return differences

    def here(self) -> list[SlicedJoint]:
        """Functions with the simulated pulses at the current coordinates."""
        windows = self.windows(self.coordinates, events(self.functions))
        return [functions.taking(windows[functions.sides.rows]) for functions in self.functions]

    def windows(self, coordinates: Values, most: int | None = None) -> FloatArray:
        """Prepared simulated pulses of the first `most` events, as input of a readout.

        Their windows are those of the centre.  Noise begins with a window: if windows followed
        the pulses, by whole samples, every step would give some pulses other noise.
        """
        pulses = self.nearby.at(coordinates, most)
        windows = stretch(pulses, self._begin[:most], self.recipe.preparation.length)
        return np.asarray(windows / pulses.max(axis=1, keepdims=True))


def events(functions: Sequence[SlicedJoint]) -> int:
    """Number of first events of which these are functions."""
    return 1 + max(int(band.sides.rows.max()) for band in functions)


def first(functions: Sequence[SlicedJoint], most: int = FOR_DERIVATIVES) -> list[SlicedJoint]:
    """Functions of the first events, sufficient for derivatives, with some of each band."""
    most = max(most, *(int(np.sort(band.sides.rows)[:OF_BAND][-1]) + 1 for band in functions))
    return [band.with_sides(band.sides.of_events(band.sides.rows < most)) for band in functions]
