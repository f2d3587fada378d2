r"""Fisher information of pulses on the physics when the readout chain is free as well.

The derivatives of the compared functions with respect to chain and physics give the information
of a number of pulses. What the chain can absorb is projected out of the physics part.
The principal axes of the remainder, in units of the priors, are the directions that the data do
or do not constrain. Two parameters with the same effect on the pulses are reported as a
direction, never as two values with small errors.

Free should be the parameters that describe held-out pulses better. Both sides are halved, every
second event. Near the current point the deviations are linear, so chain and any set of
parameters can be fitted to one half, and the deviations of the other half predicted, without
any simulation. A parameter that only follows fluctuations makes the other half worse.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from cpunet.calibration.calibrated_run import Direction
from cpunet.calibration.nuisances import Values

# A parameter is determined by the data if its error is below this fraction of its prior.
DETERMINED = 0.5
# Error of a combination of two parameters, relative to their own, below which it is given in
# their place if either is not determined.
PARALLEL = 0.3


@dataclass(frozen=True, eq=False)
class Linear:
    r"""Compared functions as they depend linearly on chain and physics.

    Parameters
    ----------
    jacobian, residuals
        Of all rows (functions, priors, further knowledge such as a depletion voltage) and
        columns (chain, then physics), in standard deviations, for all pulses.
    halves
        Deviations of the functions of each half, in the same units, shape (2, functions).
    coordinates
        Current coordinates of the physics in the columns.
    widths
        Standard deviations of the priors of all columns.
    pairs
        Number of pulses that the functions refer to (the harmonic sum of both datasets).

    Examples
    --------
    Of two parameters the first explains both halves:

    >>> rows = np.eye(4)[:, :2]
    >>> halves = np.array([[9.0, 1, 0], [9.0, -1, 0]])
    >>> linear = Linear(rows, np.array([9.0, 0, 0, 0]), halves, np.zeros(2), np.ones(2), 100.0)
    >>> [round(linear.score(chosen)) for chosen in ([], [0], [1], [0, 1])]
    [82, 1, 85, 4]

    Information of 3 and a prior of width 1 give an error of :math:`1/\sqrt{3 + 1}`.

    >>> rows, none = np.array([[3**0.5], [1.0]]), np.zeros((2, 1))
    >>> few = Linear(rows, np.zeros(2), none, np.zeros(1), np.ones(1), 100.0)
    >>> few.errors().round(6).tolist(), few.errors(pairs=500.0).tolist()
    ([0.5], [0.25])
    """

    jacobian: Values
    residuals: Values
    halves: Values
    coordinates: Values
    widths: Values
    pairs: float

    @property
    def _n_chain(self) -> int:
        return len(self.widths) - len(self.coordinates)

    def information(self, pairs: float | None = None) -> Values:
        r"""Fisher information of a number of pulses on the physics, for an unknown chain.

        With the derivatives :math:`J` of the functions with respect to chain (c) and physics
        (p), the full information is :math:`\mathcal{F} = J^T J`. The chain, with its priors
        :math:`P_c`, is eliminated,

        .. math:: F = \mathcal{F}_{pp} - \mathcal{F}_{pc}
            (\mathcal{F}_{cc} + P_c^{-1})^{-1} \mathcal{F}_{cp},

        and :math:`F` is scaled to `pairs` pulses, if given.
        """
        n, data = self._n_chain, self.jacobian[: self.halves.shape[1]]
        whole = data.T @ data
        of_chain = whole[:n, :n] + np.diag(self.widths[:n] ** -2.0)
        mixed = whole[n:, :n]
        left = whole[n:, n:] - mixed @ np.linalg.solve(of_chain, mixed.T)
        return 0.5 * (left + left.T) * (1.0 if pairs is None else pairs / self.pairs)

    def errors(self, chosen: Sequence[int] | None = None, pairs: float | None = None) -> Values:
        r"""Standard errors of the coordinates given their priors and further knowledge.

        .. math:: \sigma_i^2 = \left[(F + P^{-1} + K^T K)^{-1}\right]_{ii}

        with the derivatives :math:`K` of the further knowledge.

        Parameters
        ----------
        chosen
            Positions of the free coordinates. None for all.
        pairs
            Number of pulses; None for that of the functions.
        """
        rows = list(range(len(self.coordinates))) if chosen is None else list(chosen)
        columns, n = self._n_chain + np.array(rows, int), self.halves.shape[1]
        matrix = self.information(pairs)[np.ix_(rows, rows)]
        matrix = matrix + np.diag(self.widths[columns] ** -2.0)
        knowledge = self.jacobian[n + len(self.widths) :, columns]
        matrix += knowledge.T @ knowledge
        return np.asarray(np.sqrt(np.linalg.inv(matrix).diagonal()))

    def directions(self, names: Sequence[str], pairs: float | None = None) -> list[Direction]:
        r"""Principal axes of the information in units of the priors, best determined first.

        They are the eigenvectors of :math:`P^{1/2} F P^{1/2}` with the diagonal matrix
        :math:`P` of the prior variances.
        """
        widths = self.widths[self._n_chain :]
        sizes, axes = np.linalg.eigh(self.information(pairs) * widths[:, np.newaxis] * widths)
        directions = []
        for size, axis in zip(sizes[::-1], axes.T[::-1], strict=True):
            sign = np.sign(axis[np.argmax(np.abs(axis))])
            components = dict(zip(names, (sign * axis).tolist(), strict=True))
            error = float(1 / np.sqrt(1 + max(size, 0.0)))
            directions.append(Direction(components=components, error=error))
        return directions

    def score(self, chosen: Sequence[int]) -> float:
        """Chi-square of each half with chain and these parameters fitted to the other."""
        n, half = self.halves.shape[1], 0.5**0.5  # deviations of a half vary twice as much
        factor = np.where(np.arange(len(self.residuals)) < n, half, 1.0)
        jacobian, total = factor[:, np.newaxis] * self.jacobian, 0.0
        for train, test in (self.halves, self.halves[::-1]):
            move = self._move(jacobian, factor * np.r_[train, self.residuals[n:]], chosen)
            left = half * (test + self.jacobian[:n] @ move)
            total += float(left @ left)
        return total

    def cost(self, chosen: Sequence[int]) -> tuple[float, Values]:
        """Chi-square of all pulses with priors, and the coordinates at its minimum."""
        move = self._move(self.jacobian, self.residuals, chosen)
        left = self.residuals + self.jacobian @ move
        return float(left @ left), self.coordinates + move[self._n_chain :]

    def begin(self) -> list[int]:
        """Parameters that the pulses determine, those that held-out pulses need most first."""
        chosen, priors = list[int](), self.widths[self._n_chain :]
        while True:
            scores = {
                i: self.score([*chosen, i])
                for i, prior in enumerate(priors)
                if i not in chosen and self.errors([*chosen, i])[-1] < DETERMINED * prior
            }
            if not scores:
                return sorted(chosen)
            chosen.append(min(scores, key=lambda i: scores[i]))

    def others(self, chosen: Sequence[int]) -> Iterator[list[int]]:
        """Sets that lack a parameter, or have another in its place."""
        every = range(len(self.coordinates))
        for i in chosen:
            rest = [k for k in chosen if k != i]
            yield rest
            yield from (sorted([*rest, k]) for k in every if k not in chosen)

    def _move(self, jacobian: Values, residuals: Values, chosen: Sequence[int]) -> Values:
        """Change of all columns: the chain and those chosen are fitted, others go back to 0."""
        n = self._n_chain
        move = np.concatenate([np.zeros(n), -self.coordinates])
        fitted = [*range(n), *(n + i for i in chosen)]
        move[fitted] = 0.0
        begun = residuals + jacobian @ move
        move[fitted] = np.linalg.lstsq(jacobian[:, fitted], -begun)[0]
        return move


def together(names: Sequence[str], covariance: Values, off: Values) -> list[Direction]:
    """Combinations of two parameters of which only the combination is determined.

    Parameters
    ----------
    names
        Names of the parameters.
    covariance, off
        Their covariance, and their distances from the centres, in units of the priors.

    Returns
    -------
    list of Direction
        For each such pair the combination that is determined.

    Examples
    --------
    >>> covariance = np.array([[0.5, -0.49], [-0.49, 0.5]])
    >>> (pair,) = together(["a", "b"], covariance, np.array([1.0, 0.0]))
    >>> pair.words, round(pair.error, 6), round(pair.value, 2)
    ('0.71 a + 0.71 b', 0.1, 0.71)
    """
    pairs = []
    for i, j in combinations(range(len(names)), 2):
        pair = covariance[np.ix_([i, j], [i, j])]
        errors = np.sqrt(pair.diagonal())
        sizes, axes = np.linalg.eigh(pair)
        error = float(np.sqrt(max(sizes[0], 0.0)))
        if errors.max() > DETERMINED and error < PARALLEL * errors.min():
            axis = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
            components = {names[i]: float(axis[0]), names[j]: float(axis[1])}
            value = float(axis[0] * off[i] + axis[1] * off[j])
            pairs.append(Direction(components=components, error=error, value=value))
    return pairs
