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
        """Average pulses aligned by `paired.align_half_maximum`; others are left out."""
        return cls(int(np.isfinite(aligned).any(axis=1).sum()), known_mean(aligned)[0], before)


def known_mean(aligned: FloatArray) -> tuple[Values, npt.NDArray[np.intp]]:
    """Mean of the known values of each sample, NaN where there are none, and their number.

    It is computed in float64: sums of ten thousand float32 are off by a part of their error.
    """
    count = np.isfinite(aligned).sum(axis=0)
    total = np.nansum(aligned, axis=0, dtype=float)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), count
