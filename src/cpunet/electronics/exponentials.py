"""Linear circuits as sums of exponentials, combined by partial fractions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]

# Equal time constants are separated by this relative amount. A sum of single poles then
# represents a multiple pole: a step response changes by less than 1e-6 of its height, while
# the residues of even four equal poles keep eight digits.
_APART = 1e-3


@dataclass(frozen=True, eq=False)
class Exponentials:
    r"""A transfer function with distinct poles.

    .. math:: H(s) = d + \sum_k \frac{\rho_k}{s - p_k}

    Its step response is a sum of exponentials,

    .. math:: r(t) = d + \sum_k \frac{\rho_k}{p_k} \left(e^{p_k t} - 1\right).

    Parameters
    ----------
    direct
        Instantaneous part :math:`d`, dimensionless.
    poles, residues
        Complex arrays :math:`p_k` and :math:`\rho_k` of the same length, in 1/ns.

    Examples
    --------
    >>> two = Exponentials.low_pass(40.0) * Exponentials.low_pass(60.0)
    >>> two.step(np.array([-1.0, 0.0, 1e4])).round(6).tolist()
    [0.0, 0.0, 1.0]

    One RC integration responds to a step with :math:`1 - e^{-t/\tau}`.

    >>> bool(abs(Exponentials.low_pass(40.0).step(40.0) - (1 - np.exp(-1))) < 1e-15)
    True
    """

    direct: float
    poles: ComplexArray
    residues: ComplexArray

    @classmethod
    def of_real(
        cls, direct: float, taus_ns: Sequence[float], residues: Sequence[float]
    ) -> Exponentials:
        """Transfer function with real poles ``-1/tau`` and residues in 1/ns."""
        poles = -1 / np.asarray(taus_ns, np.complex128)
        return cls(float(direct), poles, np.asarray(residues, np.complex128))

    @classmethod
    def low_pass(cls, tau_ns: float) -> Exponentials:
        r"""RC integration, :math:`1 / (1 + s\tau)`."""
        return cls.mixed(1.0, tau_ns)

    @classmethod
    def mixed(cls, fraction: float, tau_ns: float) -> Exponentials:
        r"""Delay a `fraction` by `tau_ns`: step response :math:`1 - f e^{-t/\tau}`."""
        return cls.of_real(1 - fraction, [tau_ns], [fraction / tau_ns])

    @classmethod
    def decaying(cls, fractions: Sequence[float], taus_ns: Sequence[float]) -> Exponentials:
        r"""RC coupling: step response :math:`\sum_i f_i e^{-t/\tau_i}`."""
        residues = [-f / tau for f, tau in zip(fractions, taus_ns, strict=True)]
        return cls.of_real(sum(fractions), taus_ns, residues)

    def at(self, s: ComplexArray) -> ComplexArray:
        """Evaluate ``H(s)`` at `s` in 1/ns. `s` must not be a pole."""
        parts = self.residues / (np.asarray(s, np.complex128)[..., None] - self.poles)
        return np.asarray(self.direct + parts.sum(axis=-1))

    def __mul__(self, other: Exponentials) -> Exponentials:
        """Cascade two circuits. They must not share a pole."""
        return Exponentials(
            self.direct * other.direct,
            np.r_[self.poles, other.poles],
            np.r_[self.residues * other.at(self.poles), other.residues * self.at(other.poles)],
        )

    def step(self, t_ns: npt.ArrayLike) -> FloatArray:
        """Response to a unit step at 0, at times in ns; zero before it."""
        t = np.asarray(t_ns, float)
        modes = np.expm1(np.maximum(t, 0)[..., None] * self.poles) * (
            self.residues / self.poles
        )
        return np.where(t >= 0, self.direct + modes.sum(axis=-1).real, 0.0)


def moved_apart(taus_ns: Sequence[float]) -> list[float]:
    """Separate time constants that agree within 0.1 %, about their mean; keep the order.

    Examples
    --------
    >>> [round(tau, 3) for tau in moved_apart([40.0, 500.0, 40.0])]
    [39.98, 500.0, 40.02]
    """
    values = np.array(taus_ns, float)
    groups: list[tuple[list[int], FloatArray]] = []  # of values, and where they move
    for i in np.argsort(values, kind="stable").tolist():
        group, moved = [i], values[[i]]
        # the more values are in a group, the farther it reaches
        while groups and moved[0] < (1 + _APART) * groups[-1][1][-1]:
            group = groups.pop()[0] + group
            steps = np.arange(len(group)) - (len(group) - 1) / 2
            moved = values[group].mean() * (1 + _APART * steps)
        groups.append((group, moved))
    for group, moved in groups:
        values[group] = moved
    return [float(tau) for tau in values]
