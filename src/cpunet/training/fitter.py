"""One fit of a response after another, and what each gains on pulses that it has not seen.

Fits share settings and a count of steps.  To compare them, a part of the pulses of both sides
is held out.  Fits of the others are compared by the moments of these, and the first of them is
kept unless another gains beyond two errors by bootstrap.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from cpunet.electronics.drawn_pile_up import KnownDecay
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.schema import MatchingConfig
from cpunet.training.levenberg_marquardt import levenberg_marquardt
from cpunet.training.moments import Rows, Values
from cpunet.training.response_problem import Band, BandComparison, ResponseProblem

Listener = Callable[[int, float], None]

# Chi-square per moment, with as many pulses as are used to search for the valley, below which a
# fit has found the right one.  Outliers in the data and the ridge keep it above 1.
GOOD_FIT = 1.6
FOLLOWING = 4  # steps of a fit after a small change


class Fitted(NamedTuple):
    """A comparison at the minimum of a fit.

    Parameters
    ----------
    problem
        Comparison whose response was fitted.
    cost
        Sum of its squared residuals.
    covariance
        Covariance of its parameters.
    """

    problem: ResponseProblem
    cost: float
    covariance: Values

    @property
    def per_moment(self) -> float:
        """Sum of the squared residuals per moment."""
        return self.cost / self.problem.moments

    @property
    def poor(self) -> bool:
        """Whether the fit has not found its valley."""
        return self.per_moment >= GOOD_FIT


@dataclass(eq=False)
class Fitter:
    """Fit responses with the same settings, and count the steps of all fits.

    Parameters
    ----------
    training
        Settings of the fits.
    decay
        Main decay as known from pile-up tails, if it is.
    listener
        Called with the number of steps so far, and chi-square.
    seed
        Seed of the pulses that are held out.
    steps
        Number of steps so far.
    gains
        What held-out pulses say of each part that was tried.
    """

    training: MatchingConfig
    decay: KnownDecay | None = None
    listener: Listener | None = None
    seed: int = 0
    steps: int = 0
    gains: dict[str, str] = field(default_factory=dict)

    def follow(self, problem: ResponseProblem) -> Fitted:
        """Take a few steps from the current response, after a small change of the pulses."""
        return self.fit(problem, coarse=False, steps=FOLLOWING)

    def fit(
        self, problem: ResponseProblem, *, coarse: bool = True, steps: int | None = None
    ) -> Fitted:
        """Fit from the current response; `coarse` if it is far from the data."""
        steps = steps or self.training.steps
        found = levenberg_marquardt(problem, steps, self.count, coarse=coarse)
        parameters = problem.parameters
        priors = np.diag(parameters.widths**-2.0)
        information = np.asarray(np.linalg.inv(found.covariance), float) - priors
        return Fitted(problem, found.cost, parameters.covariance(information))

    def count(self, chi_square: float) -> None:
        """Count a step, and report it."""
        self.steps += 1
        if self.listener is not None:
            self.listener(self.steps, chi_square)


Case = tuple[ElectronicsResponse, int | None]

RESAMPLED, SURE = 200, 2.0


@dataclass(frozen=True)
class Gain:
    """Chi-squares per moment of held-out pulses, and errors of their differences.

    Parameters
    ----------
    mismatch, error
        For each of the fits compared, and of its difference from the first.
    """

    mismatch: list[float]
    error: list[float]

    @property
    def best(self) -> int:
        """The best of those that gain beyond `SURE` errors; 0 if none does."""
        found = np.array(self.mismatch)
        sure = found[0] - found > SURE * np.array(self.error)
        return int(np.argmin(np.where(sure, found, found[0])))

    def __str__(self) -> str:
        first, last, error = self.mismatch[0], self.mismatch[-1], self.error[-1]
        return (
            f"chi-square of held-out pulses {first:.2f} → {last:.2f} ± {error:.2f} per moment"
        )


def split(
    bands: Sequence[Band], share: float, rng: np.random.Generator
) -> tuple[list[Band], list[Band]]:
    """Bands without a share of their pulses, and that share."""
    known, held = [], []
    for band in bands:
        sim, data = (rng.permutation(n) for n in (len(band.sim), len(band.moments.data)))
        first, second = round(share * len(sim)), round(share * len(data))
        held.append(_part(band, np.sort(sim[:first]), np.sort(data[:second])))
        known.append(_part(band, np.sort(sim[first:]), np.sort(data[second:])))
    return known, held


def _part(band: Band, sim: Rows, data: Rows) -> Band:
    moments = band.moments
    own = replace(moments, data=moments.data[data], values=moments.values[data])
    return Band(band.name, replace(band.sim.of(sim), moments=own), band.rows[sim])


class HeldOutPulses:
    """Functions of held-out pulses, from which chi-square follows for any sample of them.

    Parameters
    ----------
    bands, known
        Held-out pulses, and those that were fitted: their covariance is better known.
    response
        The fitted response.
    """

    def __init__(
        self, bands: Sequence[Band], known: Sequence[Band], response: ElectronicsResponse
    ) -> None:
        # functions and weights of both sides
        self.sides = []
        for band in bands:
            data, sim = band.moments.values, band.sim
            simulated = sim.of_each(response, band.moments.functions), sim.weights
            self.sides.append((simulated, (data, np.ones(len(data)))))
        self.comparisons = [BandComparison(band) for band in known]
        self.scales = [held.pairs / band.pairs for held, band in zip(bands, known, strict=True)]

    def chi_square(self, rng: np.random.Generator | None = None) -> float:
        """Per moment, of all pulses or of pulses drawn from them with replacement."""
        total, n = 0.0, 0
        for sides, of, scale in zip(self.sides, self.comparisons, self.scales, strict=True):
            means = []
            for values, weights in sides:
                size = len(values)
                rows = np.arange(size) if rng is None else rng.integers(size, size=size)
                means.append(np.average(values[rows], axis=0, weights=weights[rows]))
            white = of.whiten @ ((means[0] - means[1]) / of.sigma)
            total, n = total + scale * float(white @ white), n + len(white)
        return total / n


def compared(fits: Sequence[Sequence[HeldOutPulses]], seed: int) -> Gain:
    """Chi-squares of fits, means of their parts; errors from the same samples of pulses."""

    def chi_squares(draw: int | None) -> list[float]:
        found = []
        for parts in fits:
            rng = None if draw is None else np.random.default_rng((seed, draw))
            found.append(float(np.mean([part.chi_square(rng) for part in parts])))
        return found

    found = chi_squares(None)
    drawn = np.array([chi_squares(draw) for draw in range(RESAMPLED)])
    return Gain(found, (drawn - drawn[:, :1]).std(axis=0).tolist())


def held_out_gain(cases: Sequence[Case], bands: Sequence[Band], fitter: Fitter) -> Gain:
    """Fit responses to each half of the pulses, and compare them on the other.

    Parameters
    ----------
    cases
        Each a response near its minimum, and to how many of the bands it is fitted (None: all).
    bands
        Bands that are divided, and on all of which the fits are compared.
    fitter
        Fitter of the responses, which are left as they are.
    """
    halves = split(bands, 0.5, np.random.default_rng(fitter.seed))
    fits = []
    for response, n_fitted in cases:
        parts = []
        for known, held in (halves, halves[::-1]):
            fitted = copy.deepcopy(response)
            fitter.follow(ResponseProblem(fitted, known[:n_fitted], draws=1))
            parts.append(HeldOutPulses(held, known, fitted))
        fits.append(parts)
    return compared(fits, fitter.seed)
