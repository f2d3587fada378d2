"""The comparison that a fit of a response minimises, as a function of its parameters."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy.linalg

from cpunet.networks.response_layer import ElectronicsResponse, Spectrum, padded_length
from cpunet.pulses.container import FloatArray
from cpunet.training.differentiable import DifferentiableSet, Ways
from cpunet.training.moments import Moments, Readings, Values
from cpunet.training.translated import SimulatedSide

POLES, DECAY, DECAY_WEIGHTS = "log_poles_ns", "log_decay_us", "decay_weights"
# Widths of the priors around the start: wide for times (in their logarithm).
TIME_WIDTH = 1.0
# The same for the stretch of the drift, and for its change per us.
STRETCH, STRETCH_WIDTHS = "drift.stretch", (0.1, 0.05)
# The same of what is no time: half of the charge may be slow, and the main decay dominates.
SCALES = {DECAY_WEIGHTS: 0.03, "ringing": 0.3, "slow_weights": 0.1}
# Step of differences in widths of the priors, for what is computed in double precision.
STEP = 1e-5


class Parameters:
    """The parameters of a response as one vector, with their priors.

    Parameters
    ----------
    response
        Response with the parameters; their current values are the centres of the priors.
    """

    response: ElectronicsResponse

    def __init__(self, response: ElectronicsResponse) -> None:
        self.response = response
        named = response.parameters.items()
        self.labels = [n for n, p in named for _ in p]
        self._names = [f"{n}.{i}" for n, p in named for i in range(1, len(p) + 1)]
        self.centre = self.vector()
        self.widths = np.array([SCALES.get(name, TIME_WIDTH) for name in self.labels])
        if response.decay_known is not None:
            self.widths[self.labels.index(DECAY)] = response.decay_known
        self.longest = self.widths.copy()
        self.low = np.full(len(self.centre), -np.inf)
        self.high = -self.low
        self._stretched = [i for i, label in enumerate(self.labels) if label == STRETCH]
        self.widths[self._stretched] = STRETCH_WIDTHS[: len(self._stretched)]

    def vector(self) -> Values:
        """Parameters as one vector."""
        return np.concatenate([*self.response.parameters.values()])

    def set(self, vector: Values) -> None:
        """Set the parameters of the response from a vector."""
        first = 0
        for part in self.response.parameters.values():
            part[:] = vector[first : first + len(part)]
            first += len(part)

    def ways(self, sim: SimulatedSide) -> Ways:
        """How records of some pulses change with each parameter, those of a stretch last."""
        ends = [self._ends(i) for i in self._stretched]
        slopes = [slope for _, slope in self.slopes_of_transfer(padded_length(sim.length))]

        def of_pulses(rows: slice) -> FloatArray:
            pulses = sim.sim[rows].astype(float)
            found = np.empty((len(ends), *pulses.shape), np.float32)
            for change, (a, b, step) in zip(found, ends, strict=True):
                change[:] = (b.drifted(pulses) - a.drifted(pulses)) / step
            return found

        return Ways(self.response, np.stack(slopes), of_pulses)

    def slopes_of_transfer(self, padded: int) -> list[tuple[float, Spectrum]]:
        """Widths of all parameters but a stretch, and how the spectrum changes with each."""
        found: list[tuple[float, Spectrum]] = []
        for i, label in enumerate(self.labels):
            if label != STRETCH:
                a, b, step = self._ends(i)
                change = (b.transfer(padded) - a.transfer(padded)) / step
                found.append((float(self.widths[i]), change))
        return found

    def _ends(self, i: int) -> tuple[ElectronicsResponse, ElectronicsResponse, float]:
        """Copies of the response on both sides of it along one coordinate, and their distance.

        What they compute in double precision differs in proportion.
        """
        here, step, ends = self.vector(), STEP * self.widths[i], []
        low, high = max(here[i] - step, self.low[i]), here[i] + step
        for end in (low, high):
            there = here.copy()
            there[i] = end
            self.set(there)
            ends.append(copy.deepcopy(self.response))
        self.set(here)
        return ends[0], ends[1], high - low

    def by_name(self, values: Values) -> dict[str, float]:
        """Values of the parameters by name and number."""
        return dict(zip(self._names, values.tolist(), strict=True))


SLOWEST = -0.99  # rate of the slowest decay: a hundred times slower than at the start
SQUARE_WIDTH = 0.25  # of the prior for the square of half the difference of two logarithms


class SmoothParameters(Parameters):
    r"""The parameters in coordinates on which pulses depend nearly linearly.

    Two poles act alike: pulses depend on the mean of their logarithms and on the *square* of
    their difference, and each pair is replaced by these.  Where two poles are equal,
    derivatives with respect to the difference vanish, and steps along it go astray.

    Tails depend on the rate of the main decay times its share.  With the shares :math:`a_i` of
    the faster ones, its time :math:`\tau` is replaced by

    .. math:: r = \Big(1 - \sum_i a_i\Big) \left(\frac{\tau_0}{\tau} - 1\right).

    Tails determine all these together a hundred times better than each.  In other coordinates,
    a step from one to another would curve out of this valley.

    Parameters
    ----------
    response
        Response with the parameters.
    start
        Response on whose values the priors of the same parameters are centred; those of others
        on the current ones.  Its decay is :math:`\tau_0`.
    poles
        Whether the poles are replaced, too.
    """

    _pairs: Sequence[tuple[int, int]] = ()
    _decay: int | None = None

    def __init__(
        self,
        response: ElectronicsResponse,
        start: ElectronicsResponse | None = None,
        *,
        poles: bool = True,
    ) -> None:
        super().__init__(response)
        known = {} if start is None else (own := Parameters(start)).by_name(own.centre)
        current = self.by_name(self.centre)
        centre = np.array([known.get(name, value) for name, value in current.items()])
        of_poles = [i for i, label in enumerate(self.labels) if poles and label == POLES]
        self._pairs = list(zip(of_poles[::2], of_poles[1::2], strict=False))
        self._plain_widths = self.widths.copy()
        for mean, square in self._pairs:
            self.widths[mean] /= np.sqrt(2)
            self.widths[square] = self.longest[square] = SQUARE_WIDTH
            self.low[square] = 0.0
        self._shares = np.array([label == DECAY_WEIGHTS for label in self.labels])
        if DECAY in self.labels:
            self._decay = self.labels.index(DECAY)
            self._log_reference = centre[self._decay]
            self.low[self._decay] = SLOWEST
        self.centre = self._of(centre)

    def vector(self) -> Values:
        """Coordinates of the current response."""
        return self._of(super().vector())

    def set(self, vector: Values) -> None:
        """Set the response from its coordinates."""
        plain = vector.copy()
        for mean, square in self._pairs:
            half = np.sqrt(max(vector[square], 0.0))
            plain[mean], plain[square] = vector[mean] + half, vector[mean] - half
        if (i := self._decay) is not None:
            rate = 1 + vector[i] / self._main_share(vector)
            plain[i] = self._log_reference - np.log(max(rate, 1 + SLOWEST))
        super().set(plain)

    def covariance(self, information: Values) -> Values:
        """Covariance of the parameters themselves, which have priors of their own.

        Parameters
        ----------
        information
            What the data alone tell of the coordinates: products of the derivatives of all
            residuals but those of the priors.
        """
        turn = self.turn()
        plain = turn.T @ information @ turn + np.diag(self._plain_widths**-2.0)
        return np.asarray(np.linalg.inv(plain), float)

    def turn(self) -> Values:
        """Derivatives of the coordinates in the parameters themselves, here."""
        here = self.vector()
        turn = np.eye(len(here))
        for mean, square in self._pairs:
            half = np.sqrt(max(here[square], 0.0))
            turn[mean, [mean, square]] = 0.5
            turn[square, [mean, square]] = half, -half
        if (i := self._decay) is not None:
            share = self._main_share(here)
            turn[i, self._shares] = -here[i] / share
            turn[i, i] = -(share + here[i])
        return turn

    def _of(self, plain: Values) -> Values:
        """Coordinates of a vector of parameters."""
        place = plain.copy()
        for mean, square in self._pairs:
            first, second = plain[mean], plain[square]
            place[mean], place[square] = 0.5 * (first + second), 0.25 * (first - second) ** 2
        if (i := self._decay) is not None:
            rate = np.expm1(self._log_reference - plain[i])
            place[i] = self._main_share(plain) * rate
        return place

    def _main_share(self, plain: Values) -> float:
        """Share of the main decay."""
        return float(1 - plain[self._shares].sum())


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

    def allow_for_model_error(self) -> None:
        """Give little weight to the moments that physics determine, rather than electronics.

        If no response makes the sets agree, the simulated physics are wrong.  The shape of the
        edge would then distort the response.  Instead, current amplitude, top and tail
        determine it, see `Moments.model_errors`.
        """
        self._comparisons = [
            BandComparison(b, b.moments.model_errors, self.draws) for b in self.bands
        ]

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

    def __init__(
        self, band: Band, model_errors: Values | None = None, draws: int | None = None
    ) -> None:
        self.sim, self.moments, self.draws = band.sim, band.moments, draws
        values = self.moments.values
        self.wanted = values.mean(axis=0)
        covariance = np.cov(values.T) / band.pairs
        self.sigma = np.maximum(np.sqrt(covariance.diagonal()), 1e-12)
        correlation = covariance / self.sigma[:, np.newaxis] / self.sigma
        ridge = self.moments.config.ridge
        correlation = (1 - ridge) * correlation + ridge * np.eye(len(correlation))
        if model_errors is not None:
            correlation = correlation + np.diag(model_errors**2)
        self.whiten = scipy.linalg.cholesky(np.linalg.inv(correlation))

    def derivatives(self, parameters: Parameters, clip: float | None) -> Values:
        """Derivatives of the uncorrelated deviations, shape (moments, parameters)."""
        functions, ways = partial(self.moments.functions, clip=clip), parameters.ways(self.sim)
        slopes = DifferentiableSet(self.sim).slopes(ways, functions, draws=self.draws)
        return np.asarray(self.whiten @ (slopes.T / self.sigma).T)

    def pulls(self, response: ElectronicsResponse, clip: float | None) -> Values:
        def of(readings: Readings) -> tuple[Values, ...]:
            return (readings.weights @ self.moments.functions(readings, clip),)

        # far from the data many tails are outside their range, and none may be excluded
        (total,), n = self.sim.sums(response, of, cut=clip is None, draws=self.draws)
        return np.asarray((total / max(n, 1e-9) - self.wanted) / self.sigma)
