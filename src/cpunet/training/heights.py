"""Fit what electronics do to a pulse by its height, from lines and continua together.

Chain, follower and curve (`cpunet.networks.by_height`) are solved together by the steps of
Gauss and Newton on the comparison at every sample, with derivatives by finite differences at
fixed noise.  Half of the pulses are held out: without a gain in their chi-square the readout
stays linear.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
import numpy.typing as npt
import scipy.linalg

from cpunet.networks.by_height import CURVE_KNOTS, LAG_KNOTS, PER_STEP
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.aligned import Aligned, Floats, Values
from cpunet.training.chain_fit import Fitted, chi_square
from cpunet.training.chain_parameters import SmoothParameters, with_settings
from cpunet.training.comparison import Comparison, Sides
from cpunet.training.deviations import SHARED, Linearised, posterior

# Stages: most pulses of a side, width of the bounded functions, and least error of a quantile,
# since those of a limited current are all but equal.
STAGES = ((512, 60.0, 3e-3), (512, 6.0, 1e-3), (1024, 1.5, 2e-4))
MOST = 2048  # pulses that are fitted, and as many that are held out
LIMITS = (2.0, 1.4, 1.1, 0.9, 0.75, 0.6, 0.5)  # of a slew rate to begin with, in largest steps
STEPS, SETTLED, FIRST, TRIES = 10, 3.0, 1e-3, 5  # gain that ends a stage; damping, and tries
GAIN = 20.0  # in chi-square of pulses that were held out
# Priors: variances of the follower's logarithm per largest step, widths of the curve in parts
# of its height, and its correlation length in knots.
LAGS, CURVES, NEAR = (1e-6, 1e-3, 0.03, 0.3), (1e-6, 1e-4, 3e-4, 1e-3, 3e-3), 1.5
PART, LAG_STEP, CURVE_STEP = 0.02, 0.01, 1e-4  # of the differences


class Moves:
    """Derivatives of aligned pulses by finite differences, as of `derivatives.Derivatives`.

    Parameters
    ----------
    sides
        Pulses.
    aligned, moved
        As they are, and after a step of each coordinate.
    steps
        Lengths of these.
    """

    def __init__(
        self, sides: Sides, aligned: Aligned, moved: Sequence[Aligned], steps: Values
    ) -> None:
        self.log_amplitude, self.rise = (
            np.stack([getattr(after, by) - getattr(aligned, by) for after in moved], 1) / steps
            for by in ("log_amplitude", "rise")
        )
        view = sides.view(aligned.pulses)
        self.views = [
            (sides.view(after.pulses) - view) / np.float32(step)
            for after, step in zip(moved, steps, strict=True)
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
    steps = [_largest_step(sides, sides.translated(transfer)) for sides in bands]
    by_height.step_kev[...] = max(steps)
    by_height.top_kev[...] = 1.02 * max(float(sides.energy_kev.max()) for sides in bands)
    behind = [sides.entering(own) for sides in bands]
    halves = [min(len(sides), len(sides.data), 2 * MOST) // 2 for sides in bands]
    fitted = [sides.of(n) for sides, n in zip(behind, halves, strict=True)]
    for most, width, least in STAGES:
        covariance = _solve(own, [sides.of(most) for sides in fitted], width, least, count)
    held = [sides.some(slice(n, 2 * n)) for sides, n in zip(bands, halves, strict=True)]
    (before, _), (after, functions) = chi_square(response, held), chi_square(own, held)
    line = f"chi-square of held-out pulses {before:.0f} → {after:.0f}"
    if before - after <= GAIN:
        return None, f"left out; {line}"
    return Fitted(own, after, round(functions), covariance), f"used; {line}"


def _largest_step(sides: Sides, translated: tuple[Floats, Floats]) -> float:
    records, heights = translated
    steps = np.diff(records, axis=1).max(axis=1) * heights * sides.energy_kev
    return float(np.quantile(steps, 0.99))


def _solve(
    own: ElectronicsResponse,
    bands: Sequence[Sides],
    width: float,
    least: float,
    count: Callable[[float], None],
) -> Values:
    """Set chain, follower and curve to their minimum of chi-square with priors.

    Returns the covariance of the chain's parameters.
    """
    by_height, parameters, padded = own.by_height, SmoothParameters(own), bands[0].padded
    assert by_height is not None
    n = len(parameters.centre)
    lag, curve = np.arange(1, LAG_KNOTS) / PER_STEP, np.arange(1, CURVE_KNOTS - 1)
    near = np.exp(-0.5 * ((curve[:, np.newaxis] - curve) / NEAR) ** 2)

    def covariance(of_lag: float, of_curve: float) -> Values:
        return np.asarray(
            scipy.linalg.block_diag(
                np.diag(parameters.widths**2),
                of_lag * np.minimum.outer(lag, lag),
                of_curve**2 * (near + 1e-4 * np.eye(len(curve))),
            )
        )

    best = LAGS[-1], CURVES[-1]
    precision = np.linalg.inv(covariance(*best))
    centre = np.r_[parameters.centre, np.zeros(len(lag) + len(curve))]
    steps = np.r_[
        PART * parameters.widths,
        np.full(len(lag), LAG_STEP),
        np.full(len(curve), CURVE_STEP),
    ]
    place = np.r_[parameters.vector(), by_height.vector]

    def put(vector: Values) -> None:
        parameters.set(vector[:n])
        by_height.set(vector[n:])

    def moves(sides: Sides, aligned: Aligned) -> Moves:
        moved, (clean, heights) = [], sides.translated(own.transfer(padded))
        for i, step in enumerate(steps):
            put(place + step * (np.arange(len(place)) == i))
            if i < n:
                new, of = sides.translated(own.transfer(padded))
                moved.append(sides.read(sides.noise.add(new, 0), of))
            else:
                moved.append(sides.read(sides.noise.add(clean, 0), heights))
        put(place)
        return Moves(sides, aligned, moved, steps)

    problem = Linearised([Comparison(sides, width, least) for sides in bands], moves)
    damping, last = FIRST, width == STAGES[-1][1]
    for _ in range(STEPS):
        cost = problem.evaluate(own.transfer(padded), place, anew=True)
        if last:  # near enough that the evidence says how much of each is needed
            start = problem.right - problem.information @ centre
            evidence = {
                choice: posterior(problem.information, start, covariance(*choice)).evidence
                for choice in product(LAGS, CURVES)
            }
            best = max(evidence, key=lambda choice: evidence[choice])
            precision = np.linalg.inv(covariance(*best))
        offset = place - centre
        cost += float(offset @ precision @ offset)
        count(cost)
        information, right = problem.information + precision, problem.right
        right = right + precision @ centre - information @ place
        if not by_height.lag.any():  # far from here, pulses are not linear in a slew rate
            costs = [cost]
            for limit in LIMITS:
                by_height.lag[1:] = np.log(lag / limit / np.tanh(lag / limit))
                costs.append(problem.evaluate(own.transfer(padded), place, anew=False))
            if nearest := int(np.argmin(costs)):
                limit = LIMITS[nearest - 1]
                place[n : n + len(lag)] = np.log(lag / limit / np.tanh(lag / limit))
                put(place)
                continue
        for _ in range(TRIES):
            scale = damping * np.diag(information.diagonal())
            move = np.linalg.solve(information + scale, right)
            put(place + move)
            offset = place + move - centre
            new = problem.evaluate(own.transfer(padded), place + move, anew=False)
            if (new := new + float(offset @ precision @ offset)) < cost:
                break
            damping *= 10
        else:
            put(place)
            break
        place, damping = place + move, 0.1 * damping
        if cost - new < SETTLED:
            break
    if best[0] == LAGS[0]:
        by_height.lag[:] = 0
    if best[1] == CURVES[0]:
        by_height.curve[:] = 0
    of_chain = SHARED**2 * np.linalg.inv(problem.information + precision)[:n, :n]
    prior = np.diag(parameters.widths**-2.0)
    return parameters.covariance(np.linalg.inv(of_chain) - prior)
