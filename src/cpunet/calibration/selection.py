r"""Which parameters of the physics should be free: those that describe held-out pulses better.

All pulses are of the energies that the calibration is made on. Both sides are halved, every
second event. Near the current point the deviations are linear, so chain and any set of
parameters can be fitted to one half, and the deviations of the other half be told, without any
simulation. A parameter that only follows fluctuations makes the other half worse.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cpunet.calibration.identifiability import TOLD, Information
from cpunet.calibration.nuisances import Values


@dataclass(frozen=True, eq=False)
class Selection:
    """Linear fits of sets of parameters, those that are not in a set being as simulated.

    Parameters
    ----------
    jacobian, residuals
        Of all rows (functions, priors, further knowledge) and columns (chain, then physics),
        for all pulses.
    halves
        Deviations of the functions of each half, in the same units, shape (2, functions).
    coordinates
        Current coordinates of the physics in the columns.

    Examples
    --------
    Of two parameters the first one explains both halves:

    >>> rows = np.eye(4)[:, :2]
    >>> one = Selection(rows, np.array([9.0, 0, 0, 0]), np.array([[9.0, 1, 0], [9.0, -1, 0]]),
    ...     np.zeros(2))
    >>> [round(one.score(chosen)) for chosen in ([], [0], [1], [0, 1])]
    [82, 1, 85, 4]
    """

    jacobian: Values
    residuals: Values
    halves: Values
    coordinates: Values

    def score(self, chosen: Sequence[int]) -> float:
        """Chi-square of each half with chain and these parameters fitted to the other."""
        n, half = self.halves.shape[1], 0.5**0.5  # deviations of a half vary twice as much
        total = 0.0
        for train, test in (self.halves, self.halves[::-1]):
            rows = np.concatenate([half * train, self.residuals[n:]])
            factor = np.concatenate([np.full(n, half), np.ones(len(rows) - n)])
            move = self._move(factor[:, np.newaxis] * self.jacobian, rows, chosen)
            left = half * (test + self.jacobian[:n] @ move)
            total += float(left @ left)
        return total

    def cost(self, chosen: Sequence[int]) -> tuple[float, Values]:
        """Chi-square of all pulses with priors, and the coordinates of the physics there."""
        move = self._move(self.jacobian, self.residuals, chosen)
        left = self.residuals + self.jacobian @ move
        return float(left @ left), self.coordinates + move[self._n_chain :]

    def begin(self, information: Information, allowed: Sequence[int]) -> list[int]:
        """Parameters that the pulses determine, the one that held-out pulses need most first.

        Parameters
        ----------
        information
            Of all columns of the physics.
        allowed
            Columns of the physics to choose from.
        """
        chosen: list[int] = []
        while True:
            known = [
                i
                for i in allowed
                if i not in chosen
                and information.errors([*chosen, i])[-1] < TOLD * information.widths[i]
            ]
            scores = {i: self.score([*chosen, i]) for i in known}
            if not scores:
                return sorted(chosen)
            chosen.append(min(scores, key=lambda i: scores[i]))

    def others(self, chosen: Sequence[int]) -> Iterator[list[int]]:
        """Sets that lack one of the parameters, or have another one in its place."""
        every = range(len(self.coordinates))
        for i in chosen:
            rest = [k for k in chosen if k != i]
            yield rest
            yield from (sorted([*rest, k]) for k in every if k not in chosen)

    @property
    def _n_chain(self) -> int:
        return int(self.jacobian.shape[1]) - len(self.coordinates)

    def _move(self, jacobian: Values, residuals: Values, chosen: Sequence[int]) -> Values:
        """Change of all columns: the chain and those chosen are fitted, others go back to 0."""
        n = self._n_chain
        move = np.concatenate([np.zeros(n), -self.coordinates])
        fitted = [*range(n), *(n + i for i in chosen)]
        move[fitted] = 0.0
        begun = residuals + jacobian @ move
        move[fitted] = np.linalg.lstsq(jacobian[:, fitted], -begun)[0]
        return move
