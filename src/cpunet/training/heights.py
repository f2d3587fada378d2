"""Fit what electronics do to a pulse by its height, from lines and continua together.

Chain, follower and curve (`cpunet.networks.by_height`) are solved together by the steps of
Gauss and Newton on the comparison at every sample, with derivatives by finite differences at
fixed noise.  Half of the pulses are held out: without a gain in their chi-square the readout
stays linear.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg

from cpunet.networks.by_height import CURVE_KNOTS, LAG_KNOTS, PER_STEP
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.aligned import Aligned, Floats, Values
from cpunet.training.chain_fit import (
    Fitted,
    Parabola,
    SmoothParameters,
    bounded_step,
    chi_square,
    with_settings,
)
from cpunet.training.deviations import SHARED, Linearised, posterior
from cpunet.training.pulse_sets import Sides


class Stage(NamedTuple):
    """Width of the bounded functions, least error of a quantile, and gain.

    Quantiles of a limited current are all but equal.  A stage ends with a step that lowers the
    cost by less than the share `gain`.
    """

    width: float
    least: float
    gain: float


FIRST, LAST = (Stage(60.0, 3e-3, 0.03), Stage(6.0, 1e-3, 0.03)), Stage(1.5, 2e-4, 0.001)
# Pulses of a side at first and later, and most that are fitted, with as many that are held out.
FEW, MANY, MOST = 512, 1024, 2048
LIMITS = (2.0, 1.4, 1.1, 0.9, 0.75, 0.6, 0.5)  # of a slew rate to begin with, in largest steps
STEPS, DAMPING, TRIES = 10, 1e-3, 5  # of a stage; damping at first, and tries
LONGER = (1.0, 2.0, 4.0)  # than a step: noise of the derivatives makes it too short
GAIN = 20.0  # in chi-square of pulses that were held out
# Priors: variances of the follower's logarithm per largest step, widths of the curve in parts
# of its height, and its correlation length in knots.
LAGS, CURVES, NEAR = (1e-6, 1e-3, 0.03, 0.3), (1e-6, 1e-4, 3e-4, 1e-3, 3e-3), 1.5
PART, LAG_STEP, CURVE_STEP = 0.02, 0.01, 1e-4  # of the differences


class Moves:
    """Derivatives of aligned pulses by finite differences, as of `aligned.Derivatives`."""

    def __init__(self, at: Unknowns, sides: Sides, aligned: Aligned, heights: Floats) -> None:
        moved, (clean, _) = list[Aligned](), sides.translated(at.own.transfer(sides.padded))
        for i, step in enumerate(at.steps):
            at.put(at.place + step * (np.arange(len(at.place)) == i))
            records = clean, heights
            if i < at.n:
                records = sides.translated(at.own.transfer(sides.padded))
            moved.append(sides.read(*records, 0))
        at.put(at.place)
        self.log_amplitude, self.rise = (
            np.stack([getattr(after, by) - getattr(aligned, by) for after in moved], 1)
            / at.steps
            for by in ("log_amplitude", "rise")
        )
        view = sides.view(aligned.pulses)
        self.views = [
            (sides.view(after.pulses) - view) / np.float32(step)
            for after, step in zip(moved, at.steps, strict=True)
        ]

    def mean(self, rows: npt.NDArray[np.intp], weights: Floats) -> Values:
        """Change of weighted sums of the stretches, shape (stretches, coordinates)."""
        return np.stack([(weights * view[rows]).sum(axis=0) for view in self.views], 1)


def with_heights(
    response: ElectronicsResponse, bands: Sequence[Sides], count: Callable[[float], None]
) -> tuple[Fitted | None, str]:
    """Follower and curve behind a response, if held-out pulses of several energies gain.

    Parameters
    ----------
    response
        The linear readout with the drift as simulated, which is not changed.
    bands
        Pulses of both sides in several bands of energy.
    count
        Called with chi-square after each step.

    Returns
    -------
    tuple
        Chain with what acts by height, None if nothing is gained, and a line on it.
    """
    own = with_settings(response, by_height=True)
    by_height = own.by_height
    assert by_height is not None
    transfer = own.transfer(bands[0].padded)
    largest = []
    for sides in bands:
        records, heights = sides.translated(transfer)
        steps = np.diff(records, axis=1).max(axis=1) * heights * sides.energy_kev
        largest.append(np.quantile(steps, 0.99))
    by_height.step_kev[...] = max(largest)
    by_height.top_kev[...] = 1.02 * max(float(sides.energy_kev.max()) for sides in bands)
    halves = [min(len(sides), len(sides.data), 2 * MOST) // 2 for sides in bands]
    fitted = [sides.of(n) for sides, n in zip(bands, halves, strict=True)]
    starts = []
    for limited in False, True:  # a slew rate makes up for a curve, and a curve for a slew rate
        start = copy.deepcopy(own)
        assert start.by_height is not None
        few = [sides.of(FEW).entering(start) for sides in fitted]
        if limited:  # the best of a few: far from it, pulses are not linear in a slew rate
            at, costs = np.arange(1, LAG_KNOTS) / PER_STEP, list[float]()
            lags = [np.log(at / limit / np.tanh(at / limit)) for limit in LIMITS]
            for lag in lags:
                start.by_height.lag[1:] = lag
                costs.append(chi_square(start, few, FIRST[0].width)[0])
            start.by_height.lag[1:] = lags[int(np.argmin(costs))]
        for stage in FIRST:
            _solve(start, few, stage, count)
        starts.append((chi_square(start, fitted)[0], start))
    own = min(starts, key=lambda start: start[0])[1]
    _solve(own, [sides.of(MANY).entering(own) for sides in fitted], LAST, count)
    held = [sides.some(slice(n, 2 * n)) for sides, n in zip(bands, halves, strict=True)]
    (before, _), (after, functions) = chi_square(response, held), chi_square(own, held)
    line = f"chi-square of held-out pulses {before:.0f} → {after:.0f}"
    if before - after <= GAIN:
        return None, f"left out; {line}"
    whole = [sides.of(2 * MOST).entering(own) for sides in bands]
    covariance = _solve(own, whole, LAST, count)
    return Fitted(own, after, round(functions), covariance), f"used; {line}"


class Unknowns:
    """Coordinates of a chain, then of the follower and of the curve behind it."""

    def __init__(self, own: ElectronicsResponse) -> None:
        assert own.by_height is not None
        self.own, self.by_height, self.chain = own, own.by_height, SmoothParameters(own)
        self.n, self.lag = len(self.chain.centre), np.arange(1, LAG_KNOTS) / PER_STEP
        curve = np.arange(1, CURVE_KNOTS - 1)
        self.near = np.exp(-0.5 * ((curve[:, np.newaxis] - curve) / NEAR) ** 2)
        others = np.full(len(self.lag), LAG_STEP), np.full(len(curve), CURVE_STEP)
        self.steps = np.concatenate([PART * self.chain.widths, *others])
        self.centre = np.r_[self.chain.centre, np.zeros(len(self.steps) - self.n)]
        free = self.by_height.lag[1:], self.by_height.curve[1:-1]
        self.place = np.r_[self.chain.vector(), *free]
        ends = np.full(len(self.steps) - self.n, np.inf)
        self.bounds = np.r_[self.chain.low, -ends], np.r_[self.chain.high, ends]

    def covariance(self, of_lag: float, of_curve: float) -> Values:
        """Of the priors."""
        return np.asarray(
            scipy.linalg.block_diag(
                np.diag(self.chain.widths**2),
                of_lag * np.minimum.outer(self.lag, self.lag),
                of_curve**2 * (self.near + 1e-4 * np.eye(len(self.near))),
            )
        )

    def put(self, vector: Values) -> None:
        """Set chain, follower and curve."""
        chain, lag, curve = np.split(vector, [self.n, self.n + LAG_KNOTS - 1])
        self.chain.set(chain)
        self.by_height.lag[1:], self.by_height.curve[1:-1] = lag, curve


def _solve(
    own: ElectronicsResponse,
    bands: Sequence[Sides],
    stage: Stage,
    count: Callable[[float], None],
) -> Values:
    """Set chain, follower and curve to their minimum of chi-square with priors.

    Returns the covariance of the chain's parameters.
    """
    unknowns, padded = Unknowns(own), bands[0].padded
    bounds = unknowns.bounds
    best, damping = (LAGS[-1], CURVES[-1]), DAMPING
    precision = np.linalg.inv(unknowns.covariance(*best))
    problem = Linearised(bands, partial(Moves, unknowns), stage.width, stage.least)

    def cost_at(place: Values, anew: bool = False) -> float:
        unknowns.put(place)
        return problem.evaluate(own.transfer(padded), place, anew=anew)

    def of_prior(place: Values) -> float:
        offset = place - unknowns.centre
        return float(offset @ precision @ offset)

    for _ in range(STEPS):
        place = unknowns.place
        cost = cost_at(place, anew=True)
        right = problem.right
        if stage is LAST:  # near enough that the evidence says how much of each is needed
            start, evidence = right - problem.information @ unknowns.centre, {}
            for choice in product(LAGS, CURVES):
                prior = unknowns.covariance(*choice)
                evidence[choice] = posterior(problem.information, start, prior)[0]
            best = max(evidence, key=lambda choice: evidence[choice])
            precision = np.linalg.inv(unknowns.covariance(*best))
        cost += of_prior(place)
        count(cost)
        information = problem.information + precision
        gradient = information @ place - precision @ unknowns.centre - right
        here = Parabola(place, cost, 0, problem.information, cost, gradient)
        for _ in range(TRIES):
            damped = precision + damping * np.diag(information.diagonal())
            step = bounded_step(here, damped, *bounds)
            tried = [np.clip(place + k * step, *bounds) for k in LONGER]
            costs = [cost_at(of_step) + of_prior(of_step) for of_step in tried]
            new = np.nan_to_num(costs, nan=np.inf)  # far away, pulses have no edge
            if new.min() < cost:
                unknowns.place = tried[int(new.argmin())]
                break
            damping *= 10
        damping *= 0.1
        if cost - new.min() < stage.gain * cost:
            break
    unknowns.put(unknowns.place)
    if best[0] == LAGS[0]:
        unknowns.by_height.lag[:] = 0
    if best[1] == CURVES[0]:
        unknowns.by_height.curve[:] = 0
    n, chain = unknowns.n, unknowns.chain
    of_chain = SHARED**2 * np.linalg.inv(problem.information + precision)[:n, :n]
    of_prior_alone = np.diag(chain.widths**-2.0)
    return chain.covariance(np.asarray(np.linalg.inv(of_chain) - of_prior_alone))
