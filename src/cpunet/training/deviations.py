r"""Deviations of a readout from a chain of few parameters: any step response.

Real circuits ring, reflect and decay in ways that no short list of parameters has.  A step
response is therefore that of a chain plus deviations at knots: every sample or 8 ns about the
edge and up to 3 µs, 96 ns later.  Their prior is a Gaussian process of three parts: smooth in
:math:`\operatorname{arsinh}(t / 96\,\mathrm{ns})`; structure and ringing, which decays; and
each knot for itself about the edge.  The chain's own parameters, a delay and the sharpness of
the edge are free, too: simulated samples are means over a period, measured ones are points.

How large and how long the deviations are is chosen by evidence (MacKay, Neural Comput. 4 (1992)
415), which for a linear problem with information A and right side b is

.. math:: \log E = \tfrac12 g^T M^{-1} g - \tfrac12 \log|M|, \qquad
    M = 1 + B^T A B, \quad K = B B^T, \quad g = B^T b,

relative to no deviations: where it is negative, the chain is right, and stays as it is.  The
differences of `cpunet.training.comparison` are linear in the deviations to a good degree, so
that a few steps of Gauss and Newton suffice from anywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.fft
import scipy.linalg
from scipy.interpolate import CubicSpline
from scipy.special import expit

from cpunet.networks.response_layer import DRAWS, ElectronicsResponse, Spectrum, deviation_lags
from cpunet.training.aligned import Derivatives, Values
from cpunet.training.chain_fit import SmoothParameters, with_settings
from cpunet.training.comparison import NONE, Comparison, Moved
from cpunet.training.joint import Joint
from cpunet.training.pulse_sets import MOST, Sides

# Knots in ns: the last of the dense ones and of all, and their spacing.
DENSE_NS, LAST_NS, APART_NS, SPARSE_NS, GROWTH = 3000.0, 6800.0, 8.0, 96.0, 1.12
ONSET_NS, LINEAR_NS, EDGE_NS = 8.0, 96.0, 192.0
FREE = 0.3  # of the priors of the chain's parameters, within which they are free
# Stages of the fit: width of the bounded functions, most pulses, and share by which a step
# must lower chi-square for another.
STAGES = ((6.0, 1024, 0.03), (1.5, MOST, 0.003))
# Most steps of a stage; lengths of a step in standard deviations below which the stage ends,
# and derivatives are used again; largest change of the step response in a step, beyond which
# pulses are far from linear.
STEPS, SETTLED, CLOSE, LARGEST = 25, 0.7, 3.0, 0.05
# Errors are larger than those of independent slices, since both kinds see the same pulses: rise
# times (10 to 90, 1 to 99, 0.1 to 99.9 %) on seven stands scatter by this factor more.
SHARED = 1.5
# The same of variances, before it is compared how shapes go with the amplitude: half-samples of
# pulses behind a ringing scatter by 1.3 to 5, and by 4 in modes that move the amplitude.
LOOSER = 4.0
MODES = 24  # of the posterior in which the amplitude moves it
GAUGE = 1e10  # pulses are scaled to their level: information that holds it
HALVED = 3  # times that a step which makes it worse is halved


@dataclass(frozen=True)
class Prior:
    """Gaussian process of the deviations, in units of the full charge; times in ns.

    Parameters
    ----------
    width, edge, length
        Of the smooth part, factor of its width about the edge, and correlation length.
    fine, fine_length, fine_decay
        The same of structure and ringing, and how long it lasts.
    rough, rough_decay
        Of each knot for itself, and how long.
    """

    width: float = 0.01
    edge: float = 2.0
    length: float = 0.5
    fine: float = 0.003
    fine_length: float = 20.0
    fine_decay: float = 250.0
    rough: float = 0.001
    rough_decay: float = 60.0

    def covariance(self, time_ns: Values) -> Values:
        """Covariance of the deviations at these times."""
        begun, decay = expit(time_ns / ONSET_NS), -np.abs(time_ns)
        edge = 1 + (self.edge - 1) * np.exp(-((time_ns / EDGE_NS) ** 2))
        smooth = self.width * edge * begun, np.arcsinh(time_ns / LINEAR_NS), self.length
        fine = self.fine * np.exp(decay / self.fine_decay) * begun, time_ns, self.fine_length
        covariance = np.zeros((len(time_ns), len(time_ns)))
        for width, place, length in (smooth, fine) if self.fine else (smooth,):
            near = np.exp(-0.5 * ((place[:, np.newaxis] - place) / length) ** 2)
            covariance += width[:, np.newaxis] * width * near
        rough = self.rough * np.exp(decay / self.rough_decay)
        return np.asarray(covariance + np.diag(rough**2 + 1e-12))


CHOICES: dict[str, tuple[float, ...]] = {
    "width": (0.0001, 0.0003, 0.001, 0.003, 0.01, 0.03),
    "fine": (0.0, 0.001, 0.003, 0.01, 0.03, 0.1),
    "fine_decay": (60.0, 120.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0),
    "fine_length": (12.0, 20.0, 30.0, 45.0),
    "rough": (1e-5, 1e-4, 3e-4, 1e-3, 3e-3),
    "rough_decay": (20.0, 60.0, 200.0),
    "length": (0.2, 0.35, 0.5, 0.8),
    "edge": (1.0, 2.0, 5.0),
}
STARTS = (
    Prior(),
    Prior(rough=1e-5),
    Prior(fine=0.0),
    Prior(width=0.001, fine=0.0, rough=1e-5),
    Prior(width=0.003, fine=0.01, fine_length=12.0, fine_decay=120.0, rough=1e-5),
)
FURTHER, BETTER = 2, 0.1  # starts that are followed; gain in evidence that counts


def posterior(information: Values, right: Values, covariance: Values) -> tuple[float, Values]:
    """Logarithm of the evidence of a prior covariance, and mean of the coordinates.

    Examples
    --------
    A measurement of 3 ± 1 with a prior of width 1 gives half of it:

    >>> unit = np.ones((1, 1))
    >>> posterior(unit, np.array([3.0]), unit)[1].round(6).tolist()
    [1.5]
    """
    root = np.linalg.cholesky(covariance)
    inner = np.eye(len(root)) + root.T @ information @ root
    factor, g = scipy.linalg.cho_factor(inner), root.T @ right
    z = scipy.linalg.cho_solve(factor, g)
    return float(0.5 * g @ z - np.log(factor[0].diagonal()).sum()), root @ z


def best_prior(
    information: Values, right: Values, knots: Knots, starts: Sequence[Prior]
) -> Prior:
    """The prior of the highest evidence, its values changed in turn."""

    def of(prior: Prior) -> float:
        return posterior(information, right, knots.covariance(prior))[0]

    followed = sorted(((of(prior), i) for i, prior in enumerate(starts)), reverse=True)
    candidates = []
    for best, i in followed[:FURTHER]:
        prior, before = starts[i], -np.inf
        while best > before + 1:
            before = best
            for name, values in CHOICES.items():
                if name.startswith("fine_") and not prior.fine:
                    continue
                for value in values:
                    other = replace(prior, **{name: value})
                    if other != prior and (tried := of(other)) > best + BETTER:
                        best, prior = tried, other
        candidates.append((best, prior))
    return max(candidates, key=lambda candidate: candidate[0])[1]


class Knots:
    """Knots of the deviations, the lags of the response between, and the chain's directions.

    Parameters
    ----------
    response
        The chain.
    padded
        Length of the transforms.

    Attributes
    ----------
    time_ns
        Times of the knots.
    between
        Deviations at the lags by those at the knots, shape (lags, knots).
    tangents
        Changes of the chain at the knots within which it is free, shape (knots, directions).
    """

    def __init__(self, response: ElectronicsResponse, padded: int) -> None:
        dt_ns, lags = float(response.dt_ns), deviation_lags(float(response.dt_ns))
        self.lags = lags
        spacing, last = max(1, round(APART_NS / dt_ns)), round(LAST_NS / dt_ns)
        knots, step = [*range(lags[0], round(DENSE_NS / dt_ns) + 1, spacing)], float(spacing)
        while knots[-1] < last:
            step = min(GROWTH * step, SPARSE_NS / dt_ns)
            knots.append(min(knots[-1] + max(1, round(step)), last))
        places = np.array(knots)
        self.time_ns = places * dt_ns
        time, inside = lags * dt_ns, lags <= last
        late = DENSE_NS * (1 + np.log(np.maximum(time, 1.0) / DENSE_NS))
        scaled = np.where(time < DENSE_NS, time, late)
        spline = CubicSpline(scaled[places - lags[0]], np.eye(len(knots)), bc_type="natural")
        self.between = np.zeros((len(lags), len(knots)))
        self.between[inside] = spline(scaled[inside])
        base = scipy.fft.irfft(response.transfer(padded), padded)[lags]
        # beyond the last knot a deviation decays with the chain
        self.between[~inside, -1] = base[~inside] / base[last - lags[0]]
        parameters = SmoothParameters(response)
        changes = parameters.basis(padded)
        # half a sample of delay, and a variance of a sample squared, of either sign
        slope = np.gradient(base)
        others = 0.5 * slope, 0.5 * np.gradient(slope)
        free = FREE * parameters.widths[: changes.shape[1]] * changes
        self.tangents = np.column_stack([free, *others])[places - lags[0]]

    def covariance(self, prior: Prior) -> Values:
        """Prior covariance of the deviations at the knots, with the chain's directions."""
        return np.asarray(prior.covariance(self.time_ns) + self.tangents @ self.tangents.T)


def with_deviations(
    response: ElectronicsResponse, bands: Sequence[Sides], count: Callable[[float], None]
) -> tuple[ElectronicsResponse, Values]:
    """Deviations of a chain that has been fitted.

    Parameters
    ----------
    response
        The chain, which is not changed.
    bands
        Pulses of both sides, whose simulation has passed any stretch of the drift.
    count
        Called with chi-square after each step.

    Returns
    -------
    tuple
        The chain with deviations, or the chain itself if they gain nothing; deviations of unit
        prior variance that the pulses determine, shape (lags, modes).
    """
    padded, frame = bands[0].padded, bands[0].frame
    knots = Knots(response, padded)
    own = with_settings(response, deviations=True)
    inside = (knots.lags >= frame.level[0]) & (knots.lags < frame.level[1])
    gauge = knots.between[inside].mean(axis=0)
    place, prior, begun = np.zeros(len(knots.time_ns)), STARTS[0], False
    for width, most, gain in STAGES:
        some = [side.of(most) for side in bands]
        problem = Linearised(some, partial(Derivatives, knots.between), width)
        before, far, halved = (np.inf, place), True, 0
        for _ in range(STEPS):
            own.deviation[:] = knots.between @ place
            cost = problem.evaluate(own.transfer(padded), place, anew=far)
            count(cost)
            if not cost <= 1.02 * before[0] + 5:  # worse, or no number
                place, halved = 0.5 * (place + before[1]), halved + 1
                if halved > HALVED:
                    break
                continue
            gained, before, halved = before[0] - cost, (cost, place), 0
            information = problem.information + GAUGE * np.outer(gauge, gauge)
            if far:
                starts = [prior] if begun else STARTS
                prior = best_prior(information, problem.right, knots, starts)
            covariance = knots.covariance(prior)
            evidence, new = posterior(information, problem.right, covariance)
            if not begun and evidence < 0:
                return response, NONE
            begun = True
            largest = np.abs(knots.between @ (new - place)).max()
            place = place + (move := (new - place) * min(1.0, LARGEST / largest))
            size = float(np.sqrt(move @ problem.information @ move))
            far = size > CLOSE
            if size < SETTLED or gained < gain * cost:
                break
    if not begun:
        return response, NONE
    own.deviation[:] = knots.between @ place
    cost = problem.evaluate(own.transfer(padded), place, anew=False)
    if not cost <= before[0]:
        cost, place = before
    alone = problem.evaluate(response.transfer(padded), 0 * place, anew=False)
    if not cost < alone:
        return response, NONE
    own.deviation[:] = knots.between @ place
    both = information, problem.information
    return own, _with_amplitude(own, bands, knots, place, both, covariance)


def _with_amplitude(
    own: ElectronicsResponse,
    bands: Sequence[Sides],
    knots: Knots,
    place: Values,
    informations: tuple[Values, Values],
    covariance: Values,
) -> Values:
    """Set the deviation, also by how shapes go with the amplitude, and draws of its errors.

    Slices see the amplitude less well.  Informations are with the gauge and without; returned
    are the directions of unit prior variance that the pulses determine, (lags, modes).
    """
    root = np.linalg.cholesky(covariance)
    inner = np.linalg.cholesky(np.eye(len(root)) + root.T @ informations[0] @ root)
    # directions of unit variance in which the posterior is the widest, (knots, modes)
    left, widths, _ = np.linalg.svd(root @ scipy.linalg.inv(inner).T)
    modes = left[:, :MODES] * widths[:MODES]
    # draws of the posterior, whose outer products add up to its covariance, (knots, draws)
    normal = np.random.default_rng(0).standard_normal((len(root), DRAWS)) / np.sqrt(DRAWS)
    draws = root @ scipy.linalg.solve_triangular(inner.T, SHARED * normal)

    along, transfer, n = knots.between @ modes, own.transfer(bands[0].padded), modes.shape[1]
    information, right = np.eye(n) / LOOSER, np.zeros(n)
    for sides in bands:
        difference = Joint(sides).difference(transfer, along)
        factor = np.linalg.cholesky(difference.covariance)
        slopes = scipy.linalg.solve_triangular(factor, difference.slopes, lower=True)
        information += slopes.T @ slopes
        right -= slopes.T @ scipy.linalg.solve_triangular(factor, difference.values, lower=True)
        right += difference.shared
    place = place + modes @ np.linalg.solve(information, right)
    own.deviation[:] = knots.between @ place
    own.deviation_draws[:] = (knots.between @ draws).T
    sizes, axes = np.linalg.eigh(root.T @ informations[1] @ root)
    return np.asarray(knots.between @ (root @ axes[:, sizes > 1]))


class Linearised:
    """Chi-square of comparisons to second order in the coordinates."""

    def __init__(
        self, bands: Sequence[Sides], basis: Moved, width: float, least: float = 1e-6
    ) -> None:
        self.bands, self.basis, self.how = bands, basis, (width, least)
        self.white: list[tuple[Values, Values]] = []  # roots of covariances, slopes

    def evaluate(self, transfer: Spectrum, place: Values, *, anew: bool) -> float:
        """Chi-square; information and right side with derivatives at this place if `anew`."""
        basis = self.basis if anew else None
        with np.errstate(divide="ignore", invalid="ignore"):  # far away, pulses have no edge
            here = (Comparison(sides, transfer, *self.how) for sides in self.bands)
            differences = [d for comparison in here for d in comparison.differences(basis)]
        if not all(np.isfinite(of).all() for d in differences for of in (d.slopes, d.values)):
            return np.nan
        n, cost = len(place), 0.0
        self.right = np.zeros(n)
        if anew:
            self.white, self.information = [], np.zeros((n, n))
        for i, difference in enumerate(differences):
            share = 0.5 if difference.sliced else 1.0  # both kinds of slices see the same
            if anew:
                root = np.asarray(np.linalg.cholesky(difference.covariance))
                slopes = scipy.linalg.solve_triangular(root, difference.slopes, lower=True)
                self.white.append((root, slopes))
                self.information += share * slopes.T @ slopes
            root, slopes = self.white[i]
            white = scipy.linalg.solve_triangular(root, difference.values, lower=True)
            cost += share * float(white @ white)
            self.right += share * slopes.T @ (slopes @ place - white)
        return cost
