r"""Numbers with their derivatives, for functions of pulses along many directions at once.

A value :math:`v` carries its derivatives :math:`v_k` in all directions :math:`k` through what
is computed from it, as :math:`(uv)_k = u_k v + u v_k` (automatic differentiation in forward
mode; Wengert, Comm. ACM 7 (1964) 463).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cpunet.pulses.container import FloatArray


@dataclass(frozen=True, eq=False)
class Dual:
    """Values, shape (pulses, …), and their derivatives, shape (directions, pulses, …).

    Examples
    --------
    >>> x = Dual(np.array([[3.0]]), np.array([[[1.0]]]))
    >>> y = (x**2 - 1) * x
    >>> y.value.item(), y.slopes.item()  # of x³ - x
    (24.0, 26.0)
    """

    value: FloatArray
    slopes: FloatArray

    def __getitem__(self, key: tuple[Any, ...]) -> Dual:
        return Dual(self.value[key], self.slopes[(slice(None), *key)])

    def __len__(self) -> int:
        return len(self.value)

    @property
    def shape(self) -> Sequence[int]:
        """Shape of the values."""
        return self.value.shape

    def __sub__(self, constant: Any) -> Dual:
        return Dual(self.value - constant, self.slopes)

    def __mul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            slopes = self.slopes * other.value + self.value * other.slopes
            return Dual(self.value * other.value, slopes)
        return Dual(self.value * other, self.slopes * other)

    def __truediv__(self, constant: Any) -> Dual:
        return Dual(self.value / constant, self.slopes / constant)

    def __pow__(self, power: int) -> Dual:
        return Dual(self.value**power, power * self.value ** (power - 1) * self.slopes)

    def __matmul__(self, matrix: FloatArray) -> Dual:
        return Dual(self.value @ matrix, self.slopes @ matrix)

    def exp(self) -> Dual:
        """Exponential function."""
        value = np.exp(self.value)
        return Dual(value, value * self.slopes)

    def clip(self, low: float, high: float) -> Dual:
        """Values within limits; beyond these they do not change."""
        within = (self.value >= low) & (self.value <= high)
        return Dual(self.value.clip(low, high), within * self.slopes)

    def reshape(self, rows: int, columns: int) -> Dual:
        """The same with other columns."""
        return Dual(self.value.reshape(rows, columns), self.slopes.reshape(-1, rows, columns))

    @staticmethod
    def joined(columns: Sequence[Dual]) -> Dual:
        """Columns side by side."""
        return Dual(
            np.concatenate([each.value for each in columns], axis=-1),
            np.concatenate([each.slopes for each in columns], axis=-1),
        )
