"""What a fit gains on pulses that it has not seen.

A part of the pulses of both sides is held out.  Fits of the others are compared by the moments
of these, and the first of them is kept unless another gains beyond two errors by bootstrap.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cpunet.networks.response_layer import Readout
from cpunet.training.differentiable import DifferentiableSet
from cpunet.training.fitter import Fitter
from cpunet.training.moments import Rows
from cpunet.training.response_problem import Band, Comparison, ResponseProblem

Case = tuple[Readout, int | None]

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


class HeldOut:
    """Functions of held-out pulses, from which chi-square follows for any sample of them.

    Parameters
    ----------
    bands, known
        Held-out pulses, and those that were fitted: their covariance is better known.
    response
        The fitted response.
    """

    def __init__(self, bands: Sequence[Band], known: Sequence[Band], response: Readout) -> None:
        # functions and weights of both sides
        self.sides = []
        for band in bands:
            data, sim = band.moments.values, band.sim.of(slice(None))  # of another drift
            simulated = DifferentiableSet(sim).values(response), sim.weights
            self.sides.append((simulated, (data, np.ones(len(data)))))
        self.comparisons = [Comparison(band) for band in known]
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


def compared(fits: Sequence[Sequence[HeldOut]], seed: int) -> Gain:
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
            parts.append(HeldOut(held, known, fitted))
        fits.append(parts)
    return compared(fits, fitter.seed)
