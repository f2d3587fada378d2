"""The parameters of a chain as a vector, on which pulses depend nearly linearly."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import scipy.fft

from cpunet.networks.response_layer import ElectronicsResponse, deviation_lags
from cpunet.pulses.container import FloatArray
from cpunet.training.aligned import Basis, Values

POLES, DECAY, DECAY_WEIGHTS = "log_poles_ns", "log_decay_us", "decay_weights"
# Widths of the priors around the start: wide for times (in their logarithm).
TIME_WIDTH = 1.0
# The same for the stretch of the drift, and for its change per us.
STRETCH, STRETCH_WIDTHS = "drift.stretch", (0.1, 0.05)
# The same of what is no time: half of the charge may be slow, and the main decay dominates.
SCALES = {DECAY_WEIGHTS: 0.03, "slow_weights": 0.1, "sharpness": 0.5}
# Step of differences in widths of the priors, for what is computed in double precision and
# differs in proportion; change of the stretch of the drift for its derivatives.
STEP, STRETCHED = 1e-5, 0.004


SLOWEST = -0.99  # rate of the slowest decay: a hundred times slower than at the start
SQUARE_WIDTH = 0.25  # of the prior for the square of half the difference of two logarithms


class SmoothParameters:
    r"""The parameters with their priors, in coordinates on which pulses depend nearly linearly.

    Two poles act alike: pulses depend on the mean of their logarithms and on the *square* of
    their difference, and each pair is replaced by these.  Where two poles are equal,
    derivatives with respect to the difference vanish, and steps along it go astray.

    Tails depend on the rate of the main decay times its share.  With the shares :math:`a_i` of
    the faster ones, its time :math:`\tau` is replaced by

    .. math:: r = \Big(1 - \sum_i a_i\Big) \left(\frac{\tau_0}{\tau} - 1\right).

    Tails determine all these together a hundred times better than each.  In other coordinates,
    a step between them would curve out of this valley.

    Parameters
    ----------
    response
        Response with the parameters.
    start
        Response on whose values the priors of the same parameters are centred; those of others
        on the current ones.  Its decay is :math:`\tau_0`.
    poles
        Whether the poles are replaced, too.

    Attributes
    ----------
    labels
        Name of each parameter, without its number.
    centre, widths, longest, low, high
        Centres and widths of the priors, longest steps, and bounds.
    """

    def __init__(
        self,
        response: ElectronicsResponse,
        start: ElectronicsResponse | None = None,
        *,
        poles: bool = True,
    ) -> None:
        self.response = response
        given = {} if start is None else by_name(start, vector_of(start))
        current = by_name(response, vector_of(response))
        centre = np.array([given.get(name, value) for name, value in current.items()])
        self.labels = [name.rpartition(".")[0] for name in current]
        named = np.array(self.labels)
        self.widths = np.array([SCALES.get(name, TIME_WIDTH) for name in self.labels])
        self.longest = self.widths.copy()
        self.low = np.full(len(centre), -np.inf)
        self.high = -self.low
        self.low[named == "sharpness"] = 0.0  # from means to points
        self.high[named == "sharpness"] = 1.0
        stretched = named == STRETCH
        self.widths[stretched] = STRETCH_WIDTHS[: stretched.sum()]
        self._plain_widths = self.widths.copy()
        of_poles = np.flatnonzero(named == POLES).tolist() if poles else []
        self._pairs = list(zip(of_poles[::2], of_poles[1::2], strict=False))
        for mean, square in self._pairs:
            self.widths[mean] /= np.sqrt(2)
            self.widths[square] = self.longest[square] = SQUARE_WIDTH
            self.low[square] = 0.0
        self._shares, self._decay = named == DECAY_WEIGHTS, self.labels.index(DECAY)
        self._log_reference = centre[self._decay]
        self.low[self._decay] = SLOWEST
        self.centre = self._of(centre)

    def _of(self, plain: Values) -> Values:
        """Coordinates of a vector of parameters."""
        place, i = plain.copy(), self._decay
        for mean, square in self._pairs:
            first, second = plain[mean], plain[square]
            place[mean], place[square] = 0.5 * (first + second), 0.25 * (first - second) ** 2
        rate = np.expm1(self._log_reference - plain[i])
        place[i] = float(1 - plain[self._shares].sum()) * rate
        return place

    def vector(self) -> Values:
        """Coordinates of the current response."""
        return self._of(vector_of(self.response))

    def set(self, vector: Values) -> None:
        """Set the response from its coordinates."""
        plain, i, first = vector.copy(), self._decay, 0
        for mean, square in self._pairs:
            half = np.sqrt(max(vector[square], 0.0))
            plain[mean], plain[square] = vector[mean] + half, vector[mean] - half
        rate = 1 + vector[i] / float(1 - vector[self._shares].sum())
        plain[i] = self._log_reference - np.log(max(rate, 1 + SLOWEST))
        for part in self.response.parameters.values():
            part[:] = plain[first : first + len(part)]
            first += len(part)

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
        here, i = self.vector(), self._decay
        turn = np.eye(len(here))
        for mean, square in self._pairs:
            half = np.sqrt(max(here[square], 0.0))
            turn[mean, [mean, square]] = 0.5
            turn[square, [mean, square]] = half, -half
        share = float(1 - here[self._shares].sum())
        turn[i, self._shares] = -here[i] / share
        turn[i, i] = -(share + here[i])
        return turn

    def basis(self, padded: int) -> Basis:
        """Changes of the step response with each parameter but those of a stretch."""
        changes = []
        for i in range(len(self.labels) - self.labels.count(STRETCH)):
            here, step, spectra = self.vector(), STEP * self.widths[i], []
            low, high = max(here[i] - step, self.low[i]), here[i] + step
            for end in (low, high):
                moved = here.copy()
                moved[i] = end
                self.set(moved)
                spectra.append(self.response.transfer(padded))
            self.set(here)
            changes.append((spectra[1] - spectra[0]) / (high - low))
        lags = deviation_lags(float(self.response.dt_ns))
        steps = scipy.fft.irfft(np.array(changes), padded)
        return Basis(int(lags[0]), np.ascontiguousarray(steps[:, lags].T))

    def changes(self, sim: FloatArray) -> list[FloatArray]:
        """Changes of simulated pulses with each term of a stretch, the last parameters."""
        changes = list[FloatArray]()
        for i in range(self.labels.count(STRETCH)):
            ends = []
            for sign in (-1, 1):
                moved = copy.deepcopy(self.response)
                assert moved.drift is not None
                moved.drift.stretch[i] += sign * STRETCHED
                ends.append(moved.drifted(sim))
            change = (ends[1] - ends[0]) / (2 * STRETCHED)
            changes.append(np.asarray(change, np.float32))
        return changes


def vector_of(response: ElectronicsResponse) -> Values:
    """The parameters themselves as a vector."""
    return np.concatenate([*response.parameters.values()])


def by_name(response: ElectronicsResponse, values: Values) -> dict[str, float]:
    """Values of the parameters by name and number."""
    parts = response.parameters.items()
    names = [f"{name}.{i}" for name, part in parts for i in range(1, len(part) + 1)]
    return dict(zip(names, values.tolist(), strict=True))


def with_decay(response: ElectronicsResponse, slope: float) -> ElectronicsResponse:
    """A response, its main decay set to that of the data's tails."""
    if slope < 0:
        response.log_decay_us[:] = math.log(-float(response.dt_ns) * 1e-3 / slope)
    return response


def with_settings(response: ElectronicsResponse, **settings: Any) -> ElectronicsResponse:
    """A copy of a response with other parts, which have no effect yet."""
    config = response.config.model_copy(update=settings)
    copied = ElectronicsResponse(config, float(response.dt_ns))
    old = response.arrays()
    for name, values in copied.arrays().items():
        if name in old:
            n = min(values.size, old[name].size)
            values.reshape(-1)[:n] = old[name].reshape(-1)[:n]
    return copied
