"""Test whether a correction of a chain improves pulses that it was not trained on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cpunet.networks.hybrid import RecordCorrection
from cpunet.pulses.container import FloatArray
from cpunet.recipes.schema import Recipe
from cpunet.training.edge_functions import EdgeFunctions, EdgeMisfit

RESAMPLED = 60  # bootstrap samples, for the error of the decrease of chi-square
SURE = 2.5  # minimum decrease in units of its standard deviation

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Kept:
    """Result of the test of a correction.

    Parameters
    ----------
    kept
        Whether it is used.
    rms
        RMS of what it adds around the half maximum, in pulse heights; 0 if unused.
    held_out_before, held_out_after
        Chi-square per function of the held-out sets without and with it; None if there were
        too few pulses for a test.
    """

    kept: bool
    rms: float
    held_out_before: float | None
    held_out_after: float | None


NOT_TESTED = Kept(kept=False, rms=0.0, held_out_before=None, held_out_after=None)


@dataclass(frozen=True, eq=False)
class Aim:
    """Functions of measured pulses, and their comparison with translations.

    Parameters
    ----------
    functions, misfit
        Functions and their chi-square, defined by measured pulses.
    measured
        Functions of the measured pulses that are compared, shape (pulses, functions).
    """

    functions: EdgeFunctions
    misfit: EdgeMisfit
    measured: Tensor

    @classmethod
    def at(cls, windows: FloatArray, recipe: Recipe) -> Aim:
        """Functions, weights and means of the same measured windows, shape (n, samples)."""
        functions = EdgeFunctions(windows, recipe)
        measured = functions.of_windows(windows)
        return cls(functions, EdgeMisfit(measured, recipe.matching.training.ridge), measured)

    def at_others(self, windows: FloatArray) -> Aim:
        """The same functions and weights, with the means of other measured windows."""
        return replace(self, measured=self.functions.of_windows(windows))

    def chi_square(self, made: Tensor) -> Tensor:
        """Chi-square per function, for functions of translated pulses."""
        return self._of(made, self.measured)

    def resampled(self, made: list[Tensor], rng: np.random.Generator) -> list[float]:
        """The same for several translations of one set, with one bootstrap sample of pulses."""
        n, m = len(made[0]), len(self.measured)
        rows, others = (torch.from_numpy(rng.integers(0, size, size)) for size in (n, m))
        return [float(self._of(values[rows], self.measured[others])) for values in made]

    def _of(self, made: Tensor, measured: Tensor) -> Tensor:
        pairs = 1 / (1 / max(len(made), 1) + 1 / len(measured))
        return self.misfit(made.mean(dim=0), measured.mean(dim=0), pairs)


def split_rows(n: int, share: float, rng: np.random.Generator) -> tuple[Rows, Rows]:
    """Rows to train on, and rows held out."""
    order = rng.permutation(n)
    held = max(1, round(share * n))
    return np.sort(order[held:]), np.sort(order[:held])


@torch.no_grad()
def judge(
    network: RecordCorrection,
    held_out: Aim,
    records: Tensor,
    noise: Tensor,
    least_fall: float,
    rng: np.random.Generator,
) -> Kept:
    """Compare held-out sets with and without a correction, allowing for chance.

    Parameters
    ----------
    network
        The correction, as it would be used.
    held_out
        Measured pulses that it has not seen.
    records, noise
        Records and noise of simulated pulses that it has not seen, each (pulses, samples).
    least_fall
        Fraction by which chi-square must fall; it must also fall by `SURE` standard deviations.
    rng
        Random generator of the bootstrap samples.
    """
    corrected, added = network.corrected(records)
    made = [held_out.functions.of_records(of_one + noise) for of_one in (records, corrected)]
    before, after = (float(held_out.chi_square(values)) for values in made)
    kept = len(made[0]) == len(made[1]) and after < (1 - least_fall) * before
    if kept:
        falls = [a - b for a, b in (held_out.resampled(made, rng) for _ in range(RESAMPLED))]
        kept = before - after > SURE * float(np.std(falls, ddof=1))
    rms = float(added.square().mean().sqrt()) if kept else 0.0
    return Kept(kept, rms, before, after)
