r"""The parameters of a chain, fitted to unpaired pulses by Gauss and Newton.

The differences :math:`d` of `cpunet.training.joint` are nearly linear in the coordinates
:math:`x` of `SmoothParameters`.  With their covariance :math:`C`, derivatives
:math:`J`, and a prior :math:`x_0` of covariance :math:`P`, a step is

.. math:: \delta = -(J^T C^{-1} J + P^{-1})^{-1}
    \left[J^T C^{-1} d + P^{-1} (x - x_0)\right],

damped where it leads up (Marquardt, J. SIAM 11 (1963) 431).  Derivatives are those of the
pulses that are compared, so that :math:`J^T C^{-1} d` does not vanish where both sides agree;
what it is there is subtracted (`Difference.shared`).  First steps compare some of the
pulses by wider functions, which do not saturate far from the data.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
import scipy.linalg

from cpunet.errors import CpunetError
from cpunet.networks.response_layer import ElectronicsResponse, deviation_lags
from cpunet.pulses.container import FloatArray
from cpunet.recipes.schema import MatchingConfig
from cpunet.training.aligned import Values
from cpunet.training.comparison import Comparison, Difference
from cpunet.training.joint import Joint, SingleSites
from cpunet.training.pulse_sets import Sides

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
WIDER = (16.0, 4.0)  # functions with which the valley is searched
WIDTH, WIDE = 1.5, 6.0  # of bounded functions in robust standard deviations, near and far
# Expected fall of chi-square below which search and fit end.
FALL, CONVERGED = 20.0, 0.1
# A step that leads up is damped by this much of the information's diagonal, then by so many
# times more, so often.
DAMPING, MORE, TRIES = 0.03, 8.0, 5
# Chi-square per function above which a fit has missed its valley, or has none.
POOR = 5.0
SLOW = 0.03  # share by which a step must lower a chi-square that is as poor as that


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

    def basis(self, padded: int) -> Values:
        """Changes of the step response at `deviation_lags` with each parameter but a stretch's.

        Shape (lags, parameters).
        """
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
        steps = scipy.fft.irfft(np.array(changes), padded)
        return np.ascontiguousarray(steps[:, deviation_lags(float(self.response.dt_ns))].T)

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


@dataclass(eq=False)
class Fitter:
    """Fit responses with the same settings, and count the steps of all fits.

    Parameters
    ----------
    training
        Settings of the fits.
    listener
        Called with the number of steps so far, and chi-square.
    steps
        Number of steps so far.
    gains
        What held-out pulses say of each part that was tried.
    """

    training: MatchingConfig
    listener: Callable[[int, float], None] = lambda *_: None
    steps: int = 0
    gains: dict[str, str] = field(default_factory=dict)

    def count(self, chi_square: float) -> None:
        """Count a step, and report it."""
        self.steps += 1
        self.listener(self.steps, chi_square)


class Fitted(NamedTuple):
    """A chain at a minimum.

    Parameters
    ----------
    response
        The chain.
    chi_square, functions
        Of the differences, and their number.
    covariance
        Covariance of the parameters.
    """

    response: ElectronicsResponse
    chi_square: float
    functions: int
    covariance: Values

    @property
    def poor(self) -> bool:
        """Whether the two sides do not agree."""
        return self.chi_square > POOR * self.functions


def fit_chain(
    response: ElectronicsResponse,
    bands: Sequence[Sides],
    fitter: Fitter,
    *,
    search: bool = True,
    single: Sequence[Sides] = (),
) -> Fitted:
    """Fit a chain, which is changed.

    Parameters
    ----------
    response
        Where to start.
    bands
        Pulses of both sides; the simulated ones as they are before any stretch of the drift.
    fitter
        Settings of the fit; counts its steps.
    search
        Whether the start may be far away.
    single
        Pulses whose single sites are compared, too, see `SingleSites`.

    Raises
    ------
    CpunetError
        If no chi-square is finite.
    """
    parameters = SmoothParameters(response)
    first = parameters.vector()

    def fitted(compared: list[Joint], fall: float) -> Fitted:
        def parabola(place: Values) -> Parabola:
            parameters.set(place)
            n = len(place)
            information, gradient = np.zeros((n, n)), np.zeros(n)
            chi_square, functions = 0.0, 0
            for comparison in compared:
                difference = differences(parameters, comparison)
                root = np.linalg.cholesky(difference.covariance)
                both = np.column_stack([difference.values, difference.slopes])
                white = scipy.linalg.solve_triangular(root, both, lower=True)
                values, slopes = white[:, 0], white[:, 1:]
                information += slopes.T @ slopes
                gradient += slopes.T @ values - difference.shared
                chi_square += float(values @ values)
                functions += len(values)
            off = (place - parameters.centre) / parameters.widths
            cost = chi_square + float(off @ off)
            gradient += off / parameters.widths
            return Parabola(place, chi_square, functions, information, cost, gradient)

        end = minimum(parameters, parabola, fitter.training.steps, fall, fitter.count)
        covariance = parameters.covariance(end.information)
        return Fitted(response, end.chi_square, end.functions, covariance)

    # shapes whose drift had to be stretched are not to be trusted to a thousandth
    products = response.drift is None
    few = [sides.of(fitter.training.search_pulses) for sides in bands]
    for wider in WIDER if search else ():
        fitted([Joint(sides, wider, products=products) for sides in few], FALL)
    whole = [Joint(sides, products=products) for sides in bands]
    end = fitted([*whole, *map(SingleSites, single)], CONVERGED)
    if search and end.poor:  # no chain is near, and what goes with the amplitude leads astray
        reached, costs = parameters.vector(), []
        for place in (first, reached):
            parameters.set(place)
            costs.append(chi_square(response, few, WIDE)[0])
        if costs[0] < costs[1]:
            parameters.set(first)
    return end


def chi_square(
    response: ElectronicsResponse, bands: Sequence[Sides], width: float = WIDTH
) -> tuple[float, float]:
    """Of `Comparison` for a response, and number of functions; both kinds of slices are of the
    same pulses, and each counts half.
    """
    compared = []
    for sides in bands:
        transfer = response.transfer(sides.padded)
        compared += Comparison(sides.entering(response), transfer, width).differences()
    shares = [(0.5 if d.sliced else 1.0) * len(d.values) for d in compared]
    return sum(n * d.chi_square for n, d in zip(shares, compared, strict=True)), sum(shares)


class Parabola(NamedTuple):
    """Chi-square to second order about a place, without and with the priors.

    Parameters
    ----------
    place
        Coordinates.
    chi_square, functions
        Of the differences, and their number.
    information
        Products of the derivatives of all uncorrelated residuals but those of the priors.
    cost, gradient
        Sum of the squares of all residuals, and half of its derivatives.
    """

    place: Values
    chi_square: float
    functions: int
    information: Values
    cost: float
    gradient: Values


def minimum(
    unknowns: Any,
    evaluate: Callable[[Values], Parabola],
    steps: int,
    fall: float,
    count: Callable[[float], None],
) -> Parabola:
    """Go to the minimum of the cost, and set the coordinates to it.

    Parameters
    ----------
    unknowns
        Coordinates at the start, with the widths of their priors, longest steps, and bounds:
        `SmoothParameters`, or the like.
    evaluate
        Chi-square about a place, to which it sets the coordinates.
    steps
        Most steps.
    fall
        Fall of the cost, expected or by the last step, below which the steps end.
    count
        Called with chi-square after each evaluation.

    Raises
    ------
    CpunetError
        If the cost is not finite at the end.
    """
    low, high = unknowns.low, unknowns.high
    prior, damping = np.diag(unknowns.widths**-2.0), 0.0
    best = evaluate(unknowns.vector())
    for _ in range(steps):
        step = bounded_step(best, prior, low, high)
        if -(best.gradient @ step) < fall:
            break
        for _ in range(TRIES):
            damped = prior + damping * np.diag(best.information.diagonal())
            step = bounded_step(best, damped, low, high)
            step = np.clip(step, -unknowns.longest, unknowns.longest)
            tried = evaluate(np.clip(best.place + step, low, high))
            count(tried.chi_square)
            if tried.cost < best.cost or not np.isfinite(best.cost):
                break
            damping = max(DAMPING, MORE * damping)
        else:
            break
        gained = best.cost - tried.cost
        best, damping = tried, damping / MORE if damping > DAMPING else 0.0
        poor = best.chi_square > POOR * best.functions
        if gained < (SLOW * best.cost if poor else fall):
            break
    if not np.isfinite(best.cost):
        raise CpunetError(
            "the fit of the response diverged; check that the sets hold single pulses of a "
            "detector (cpunet info), or train on other energies (`peak`)"
        )
    unknowns.set(best.place)
    return best


def bounded_step(at: Parabola, prior: Values, low: Values, high: Values) -> Values:
    """Step to the minimum; coordinates at a bound do not cross it, the others know of that."""
    free, curvature = np.ones(len(low), bool), at.information + prior
    while free.any():
        step = np.zeros(len(low))
        step[free] = -np.linalg.solve(curvature[np.ix_(free, free)], at.gradient[free])
        out = ((at.place <= low) & (step < 0)) | ((at.place >= high) & (step > 0))
        if not out.any():
            return step
        free &= ~out
    return np.zeros(len(low))


def differences(parameters: SmoothParameters, comparison: Joint) -> Difference:
    """Differences of both sides, with derivatives in the coordinates of a chain."""
    response, sides = parameters.response, comparison.sides
    transfer, basis = response.transfer(sides.padded), parameters.basis(sides.padded)
    here = comparison.with_sides(sides.entering(response))
    return here.difference(transfer, basis, parameters.changes(sides.sim))


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
