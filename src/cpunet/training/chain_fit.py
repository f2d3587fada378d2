r"""The parameters of a chain, fitted to unpaired pulses by Gauss and Newton.

The differences :math:`d` of `cpunet.training.joint` are nearly linear in the coordinates
:math:`x` of `cpunet.training.chain_parameters`.  With their covariance :math:`C`, derivatives
:math:`J`, and a prior :math:`x_0` of covariance :math:`P`, a step is

.. math:: \delta = -(J^T C^{-1} J + P^{-1})^{-1}
    \left[J^T C^{-1} d + P^{-1} (x - x_0)\right],

damped where it leads up (Marquardt, J. SIAM 11 (1963) 431).  First steps compare some of the
pulses by wider functions, which do not saturate far from the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cpunet.errors import CpunetError
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.aligned import Values
from cpunet.training.chain_parameters import SmoothParameters
from cpunet.training.comparison import Comparison, Difference, Sides
from cpunet.training.fitter import Fitter
from cpunet.training.joint import Joint, SingleSites

WIDER = (16.0, 4.0)  # functions with which the valley is searched
WIDTH = 1.5  # of bounded functions in robust standard deviations
# Expected fall of chi-square below which search and fit end.
FALL, CONVERGED = 20.0, 0.1
# A step that leads up is damped by this much of the information's diagonal, then by so many
# times more, so often.
DAMPING, MORE, TRIES = 0.03, 8.0, 5
# Chi-square per function above which a fit has missed its valley, or there is none.
POOR = 5.0
SLOW = 0.03  # share by which a step must lower a chi-square that is as poor as that
STRETCHED = 0.004  # change of the stretch of the drift, for its derivatives


class Fitted(NamedTuple):
    """A chain at a minimum.

    Parameters
    ----------
    response
        The chain.
    chi_square, functions
        Of the differences, and how many there are.
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
        If there is no finite chi-square.
    """
    parameters = SmoothParameters(response)

    def fitted(compared: list[Joint], fall: float) -> Fitted:
        end = _minimum(parameters, compared, fitter, fall)
        parameters.set(end.place)
        covariance = parameters.covariance(end.information)
        return Fitted(response, end.chi_square, end.functions, covariance)

    # shapes whose drift had to be stretched are not to be trusted to a thousandth
    products = response.drift is None
    few = [sides.of(fitter.training.search_pulses) for sides in bands]
    for wider in WIDER if search else ():
        fitted([Joint(sides, wider, products=products) for sides in few], FALL)
    whole = [Joint(sides, products=products) for sides in bands]
    return fitted([*whole, *map(SingleSites, single)], CONVERGED)


def chi_square(response: ElectronicsResponse, bands: Sequence[Sides]) -> tuple[float, float]:
    """Of `Comparison` for a response, and number of functions; both kinds of slices are of the
    same pulses, and each counts half.
    """
    found = []
    for sides in bands:
        comparison = Comparison(sides.entering(response), WIDTH)
        found += comparison.differences(response.transfer(sides.padded))
    shares = [(0.5 if d.sliced else 1.0) * len(d.values) for d in found]
    return sum(n * d.chi_square for n, d in zip(shares, found, strict=True)), sum(shares)


class _Parabola(NamedTuple):
    """Chi-square to second order about a place, without and with the priors."""

    place: Values
    chi_square: float
    functions: int
    information: Values
    cost: float
    gradient: Values


def _minimum(
    parameters: SmoothParameters, compared: Sequence[Joint], fitter: Fitter, fall: float
) -> _Parabola:
    low, high = parameters.low, parameters.high
    prior, damping = np.diag(parameters.widths**-2.0), 0.0
    best = _parabola(parameters, compared, parameters.vector())
    for _ in range(fitter.training.steps):
        step = _within(best, prior, low, high)
        if -(best.gradient @ step) < fall:
            break
        for _ in range(TRIES):
            damped = prior + damping * np.diag(best.information.diagonal())
            step = _within(best, damped, low, high)
            step = np.clip(step, -parameters.longest, parameters.longest)
            tried = _parabola(parameters, compared, np.clip(best.place + step, low, high))
            fitter.count(tried.chi_square)
            if tried.cost < best.cost or not np.isfinite(best.cost):
                break
            damping = max(DAMPING, MORE * damping)
        else:
            break
        gained = best.cost - tried.cost
        best, damping = tried, damping / MORE if damping > DAMPING else 0.0
        if best.chi_square > POOR * best.functions and gained < SLOW * best.cost:
            break
    if not np.isfinite(best.cost):
        raise CpunetError(
            "the fit of the response diverged; check that the sets hold single pulses of one "
            "detector (cpunet info), or train on other energies (`peak`)"
        )
    return best


def _within(at: _Parabola, prior: Values, low: Values, high: Values) -> Values:
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
) -> _Parabola:
    parameters.set(place)
    n = len(place)
    information, gradient, chi_square, functions = np.zeros((n, n)), np.zeros(n), 0.0, 0
    for comparison in compared:
        values, slopes = differences(parameters, comparison).white
        information += slopes.T @ slopes
        gradient += slopes.T @ values
        chi_square += float(values @ values)
        functions += len(values)
    off = (place - parameters.centre) / parameters.widths
    cost = chi_square + float(off @ off)
    gradient += off / parameters.widths
    return _Parabola(place, chi_square, functions, information, cost, gradient)


def differences(parameters: SmoothParameters, comparison: Joint) -> Difference:
    """Differences of both sides, with derivatives in the coordinates of a chain."""
    response, padded = parameters.response, comparison.sides.padded
    entering = comparison.entering(response)
    found = entering.difference(response.transfer(padded), parameters.basis(padded))
    slopes = [found.slopes]
    for ends in parameters.stretches(STRETCHED):  # the last coordinates
        low, high = (comparison.entering(end).difference(end.transfer(padded)) for end in ends)
        slopes.append((high.values - low.values)[:, np.newaxis] / (2 * STRETCHED))
    return replace(found, slopes=np.concatenate(slopes, axis=1))
