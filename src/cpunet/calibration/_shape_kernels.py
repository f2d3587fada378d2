"""Compiled loops that align pulses at their half maxima."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from cpunet.kernels import kernel


@kernel(inline="always")
def _sample(pulse: Any, at: int, length: int) -> Any:  # pragma: no cover - compiled
    """Sample of a pulse; 0 before its start, its last sample after its end."""
    if at < 0:
        return np.float32(0.0)
    return pulse[min(at, length - 1)]


@kernel(parallel=True)
def half_maxima(pulses: Any, found: Any) -> None:  # pragma: no cover - compiled
    """Sample at which each pulse reaches half its final value; unchanged if it does not."""
    for i in prange(len(pulses)):
        pulse = pulses[i]
        level = 0.5 * pulse[-1]
        for j in range(1, len(pulse)):
            if pulse[j] >= level > pulse[j - 1]:
                found[i] = j - 1 + (level - pulse[j - 1]) / (pulse[j] - pulse[j - 1])
                break


@kernel(parallel=True)
def move(pulses: Any, samples: Any, moved: Any) -> None:  # pragma: no cover - compiled
    """Shift each pulse to the left by a number of samples, with cubic interpolation."""
    for i in prange(len(pulses)):
        pulse, length = pulses[i], pulses.shape[1]
        whole = math.floor(samples[i])
        part = samples[i] - whole
        for j in range(length):
            a = _sample(pulse, j + whole - 1, length)
            b = _sample(pulse, j + whole, length)
            c = _sample(pulse, j + whole + 1, length)
            d = _sample(pulse, j + whole + 2, length)
            curved = 2 * a - 5 * b + 4 * c - d + part * (3 * (b - c) + d - a)
            moved[i, j] = b + 0.5 * part * (c - a + part * curved)
