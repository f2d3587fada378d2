r"""The parameters of a chain, fitted to unpaired pulses by Gauss and Newton.

The differences :math:`d` of `cpunet.training.joint` are nearly linear in the coordinates
:math:`x` of `cpunet.training.chain_parameters`.  With their covariance :math:`C`, derivatives
:math:`J`, and a prior :math:`x_0` of covariance :math:`P`, a step is

.. math:: \delta = -(J^T C^{-1} J + P^{-1})^{-1}
    \left[J^T C^{-1} d + P^{-1} (x - x_0)\right],

damped where it leads up (Marquardt, J. SIAM 11 (1963) 431).  Derivatives are those of the
pulses that are compared, so that :math:`J^T C^{-1} d` does not vanish where both sides agree;
what it is there is subtracted (`Difference.shared`).  First steps compare some of the
pulses by wider functions, which do not saturate far from the data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from cpunet.errors import CpunetError
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.schema import MatchingConfig
from cpunet.training.aligned import Values
from cpunet.training.bands import Sides
from cpunet.training.chain_parameters import SmoothParameters
from cpunet.training.comparison import Comparison, Difference
from cpunet.training.joint import Joint, SingleSites

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
        evaluate = partial(_parabola, parameters, compared)
        end = minimum(parameters, evaluate, fitter.training.steps, fall, fitter.count)
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


def _parabola(
    parameters: SmoothParameters, compared: Sequence[Joint], place: Values
) -> Parabola:
    parameters.set(place)
    n = len(place)
    information, gradient, chi_square, functions = np.zeros((n, n)), np.zeros(n), 0.0, 0
    for comparison in compared:
        difference = differences(parameters, comparison)
        values, slopes = difference.white
        information += slopes.T @ slopes
        gradient += slopes.T @ values - difference.shared
        chi_square += float(values @ values)
        functions += len(values)
    off = (place - parameters.centre) / parameters.widths
    cost = chi_square + float(off @ off)
    gradient += off / parameters.widths
    return Parabola(place, chi_square, functions, information, cost, gradient)


def differences(parameters: SmoothParameters, comparison: Joint) -> Difference:
    """Differences of both sides, with derivatives in the coordinates of a chain."""
    response, sides = parameters.response, comparison.sides
    transfer, basis = response.transfer(sides.padded), parameters.basis(sides.padded)
    here = comparison.with_sides(sides.entering(response))
    return here.difference(transfer, basis, parameters.changes(sides.sim))
