"""What pulses tell of the physics once a readout chain may stand in for it: Fisher first.

Derivatives of the compared functions with chain and physics give the information that a number
of pulses holds; of the physics' part, what the chain can undo is projected off.  The axes of
what is left, in units of the priors, are the directions that the data know or do not know.
Two parameters that move pulses alike are told as one direction, never as two numbers with
small errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cpunet.calibration.joint_problem import JointProblem
from cpunet.calibration.nuisances import Nuisance, Values

# A parameter is told by the data if its error becomes this part of its prior.
TOLD = 0.5
# Of a direction, components that are shown.
SHOWN = 0.25


@dataclass(frozen=True)
class Direction:
    """A combination of parameters, and how well it is known.

    Parameters
    ----------
    components
        By name, in units of the priors; the squares add up to 1.
    error
        Standard deviation with prior and data, in units of the prior: 1 if the data tell
        nothing.
    """

    components: dict[str, float]
    error: float

    @property
    def words(self) -> str:
        """The larger components, as a sum."""
        parts = sorted(self.components.items(), key=lambda part: -abs(part[1]))
        shown = [(n, c) for n, c in parts if abs(c) >= SHOWN]
        text = " ".join(f"{'+' if c > 0 else '−'} {abs(c):.2f} {n}" for n, c in shown)
        return text.removeprefix("+ ")


@dataclass(frozen=True, eq=False)
class Information:
    """Information of one set of pulses on the physics, whatever the chain may be.

    Parameters
    ----------
    nuisances
        In the order of the matrix.
    matrix
        Fisher's, of the coordinates, without their priors.
    widths
        Of the priors.
    pairs
        Pulses that it is of (the harmonic sum of both sides).
    """

    nuisances: tuple[Nuisance, ...]
    matrix: Values
    widths: Values
    pairs: float

    @classmethod
    def of(cls, problem: JointProblem, jacobian: Values) -> Information:
        """From the derivatives of all residuals of a problem."""
        parameters = problem.parameters
        n, widths = parameters.n_chain, parameters.widths
        data = jacobian[: problem.moments]
        whole = data.T @ data
        of_chain = whole[:n, :n] + np.diag(widths[:n] ** -2.0)
        mixed = whole[n:, :n]
        left = whole[n:, n:] - mixed @ np.linalg.solve(of_chain, mixed.T)
        physics = problem.nearby.simulator.physics
        nuisances = tuple(physics.nuisances[i] for i in parameters.free)
        pairs = sum(band.pairs for band in problem.bands)
        return cls(nuisances, 0.5 * (left + left.T), widths[n:], pairs)

    def for_pulses(self, pairs: float) -> Information:
        """What so many pulses would hold."""
        return Information(
            self.nuisances, self.matrix * (pairs / self.pairs), self.widths, pairs
        )

    def errors(self, chosen: Sequence[int] | None = None) -> Values:
        """Errors of the coordinates with their priors, if only the chosen ones are free."""
        rows = list(range(len(self.widths))) if chosen is None else list(chosen)
        matrix = self.matrix[np.ix_(rows, rows)] + np.diag(self.widths[rows] ** -2.0)
        return np.asarray(np.sqrt(np.linalg.inv(matrix).diagonal()))

    def directions(self) -> list[Direction]:
        """Axes of the information in units of the priors, best known first."""
        scaled = self.matrix * self.widths[:, np.newaxis] * self.widths
        sizes, axes = np.linalg.eigh(scaled)
        names = [nuisance.name for nuisance in self.nuisances]
        found = []
        for size, axis in zip(sizes[::-1], axes.T[::-1], strict=True):
            sign = np.sign(axis[np.argmax(np.abs(axis))])
            components = dict(zip(names, (sign * axis).tolist(), strict=True))
            found.append(Direction(components, float(1 / np.sqrt(1 + max(size, 0.0)))))
        return found

    def told(self) -> list[int]:
        """Positions of the parameters to set free, in their order."""
        chosen: list[int] = []
        for i, width in enumerate(self.widths.tolist()):
            if self.errors([*chosen, i])[-1] < TOLD * width:
                chosen.append(i)
        return chosen


def promises(jacobian: Values, residuals: Values, free: Sequence[int]) -> dict[int, float]:
    """By how much chi-square would fall if a column that is not free were, to first order.

    Parameters
    ----------
    jacobian, residuals
        Of all columns, with the priors' rows, where the fit of the free ones has ended.
    free
        Columns that were free.
    """
    others = [i for i in range(jacobian.shape[1]) if i not in set(free)]
    base, _ = np.linalg.qr(jacobian[:, list(free)])
    left = residuals - base @ (base.T @ residuals)
    found = {}
    for i in others:
        column = jacobian[:, i] - base @ (base.T @ jacobian[:, i])
        found[i] = float(column @ left) ** 2 / max(float(column @ column), 1e-12)
    return found
