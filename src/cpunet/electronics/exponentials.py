"""Linear circuits as sums of exponentials: impulse and step response by partial fractions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

# Equal time constants are moved apart by this, relative to each other. A sum of single
# poles then stands for a multiple one: a step response changes by less than 1e-6 of its
# height, while the residues of even four equal poles leave eight digits.
_APART = 1e-3


@dataclass(frozen=True, eq=False)
class Exponentials:
    """A transfer function ``H(s) = direct + sum(residue / (s - pole))``, poles all different.

    Parameters
    ----------
    direct
        What passes at once, without dimension.
    poles, residues
        Complex arrays of the same length, in 1/ns.

    Examples
    --------
    >>> two = Exponentials.low_pass(40.0) * Exponentials.low_pass(60.0)
    >>> two.step(np.array([-1.0, 0.0, 1e4])).round(6).tolist()
    [0.0, 0.0, 1.0]
    """

    direct: float
    poles: ComplexArray
    residues: ComplexArray

    @classmethod
    def of_real(
        cls, direct: float, taus_ns: Sequence[float], residues: Sequence[float]
    ) -> Exponentials:
        """Real poles ``-1/tau``, with residues in 1/ns."""
        poles = -1 / np.asarray(taus_ns, np.complex128)
        return cls(float(direct), poles, np.asarray(residues, np.complex128))

    @classmethod
    def low_pass(cls, tau_ns: float) -> Exponentials:
        """One RC integration: ``1 / (1 + s tau)``."""
        return cls.of_real(0.0, [tau_ns], [1 / tau_ns])

    @classmethod
    def mixed(cls, fraction: float, tau_ns: float) -> Exponentials:
        """A `fraction` takes ``tau_ns``, the rest passes: step ``1 - f exp(-t/tau)``."""
        return cls.of_real(1 - fraction, [tau_ns], [fraction / tau_ns])

    @classmethod
    def ringing(cls, fraction: float, frequency_MHz: float, damping_ns: float) -> Exponentials:
        """Step response ``1 + f exp(-t/damping) sin(2 pi frequency t)``."""
        pole = complex(-1 / damping_ns, 2 * np.pi * frequency_MHz * 1e-3)
        residue = fraction * pole / 2j
        poles, residues = [pole, pole.conjugate()], [residue, residue.conjugate()]
        return cls(1.0, np.array(poles), np.array(residues))

    @classmethod
    def decaying(cls, fractions: Sequence[float], taus_ns: Sequence[float]) -> Exponentials:
        """Step response ``sum(f exp(-t/tau))``: RC-coupled charge that leaks away."""
        residues = [-f / tau for f, tau in zip(fractions, taus_ns, strict=True)]
        return cls.of_real(sum(fractions), taus_ns, residues)

    def at(self, s: ComplexArray) -> ComplexArray:
        """``H(s)``, with `s` in 1/ns and none of the poles."""
        parts = self.residues / (np.asarray(s, np.complex128)[..., None] - self.poles)
        return np.asarray(self.direct + parts.sum(axis=-1))

    def __mul__(self, other: Exponentials) -> Exponentials:
        """One after the other; they may have no pole in common."""
        return Exponentials(
            self.direct * other.direct,
            np.concatenate([self.poles, other.poles]),
            np.concatenate(
                [
                    self.residues * other.at(self.poles),
                    other.residues * self.at(other.poles),
                ]
            ),
        )

    def impulse(self, t_ns: npt.ArrayLike) -> FloatArray:
        """Impulse response in 1/ns at times in ns, without the part that passes at once."""
        t = np.asarray(t_ns, float)
        modes = np.exp(np.maximum(t, 0)[..., None] * self.poles) * self.residues
        return np.where(t >= 0, modes.sum(axis=-1).real, 0.0)

    def step(self, t_ns: npt.ArrayLike) -> FloatArray:
        """Response to a unit step at 0, at times in ns; 0 before it."""
        t = np.asarray(t_ns, float)
        modes = np.expm1(np.maximum(t, 0)[..., None] * self.poles) * (
            self.residues / self.poles
        )
        return np.where(t >= 0, self.direct + modes.sum(axis=-1).real, 0.0)


def moved_apart(taus_ns: Sequence[float]) -> list[float]:
    """Time constants in the given order, equal ones (to 0.1 %) moved apart about their mean.

    Examples
    --------
    >>> [round(tau, 3) for tau in moved_apart([40.0, 500.0, 40.0])]
    [39.98, 500.0, 40.02]
    """
    order = np.argsort(taus_ns, kind="stable")
    values = np.asarray(taus_ns, float)
    result = values.copy()
    groups: list[list[Any]] = []
    for i in order:
        if groups and values[i] < values[groups[-1][-1]] * (1 + _APART):
            groups[-1].append(i)
        else:
            groups.append([i])
    for group in groups:
        steps = np.arange(len(group)) - (len(group) - 1) / 2
        if len(group) > 1:
            result[group] = values[group].mean() * (1 + _APART * steps)
    return [float(tau) for tau in result]
