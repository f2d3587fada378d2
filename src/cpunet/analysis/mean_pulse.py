"""The mean pulse of a set, aligned at half maximum."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]


class MeanPulse(NamedTuple):
    """Mean of `n` pulses, aligned at half maximum, which is at sample `before`."""

    n: int
    mean: Values
    before: int

    @classmethod
    def of_aligned(cls, aligned: FloatArray, before: int) -> Self:
        """Average pulses aligned by `paired.align_half_maximum`; NaN where none is known."""
        known = np.isfinite(aligned)
        count = known.sum(axis=0)
        total = np.where(known, aligned, 0).sum(axis=0, dtype=float)
        mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        return cls(len(aligned), mean, before)
