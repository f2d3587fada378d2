"""Compiled loops over cubic splines of pulses: where they cross a level, and shifted pulses."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel

Values = npt.NDArray[np.float64]
Places = npt.NDArray[np.intp]

_compiled: Any = kernel(error_model="numpy")


@_compiled
def _weights(t):  # type: ignore[no-untyped-def]
    """Weights of the coefficients at -1, 0, 1, 2 for a time between 0 and 1."""
    s = 1 - t
    return (
        s * s * s / 6,
        (3 * t * t * t - 6 * t * t + 4) / 6,
        (3 * s * s * s - 6 * s * s + 4) / 6,
        t * t * t / 6,
    )


@_compiled
def _crossings(coefficients, before, pad, levels, bisections, times):  # type: ignore[no-untyped-def]
    for row in range(len(levels)):
        at = before[row] + pad
        near = coefficients[row, at - 1 : at + 3]
        low, high = 0.0, 1.0
        for _ in range(bisections):
            middle = 0.5 * (low + high)
            a, b, c, d = _weights(middle)
            if a * near[0] + b * near[1] + c * near[2] + d * near[3] < levels[row]:
                low = middle
            else:
                high = middle
        times[row] = before[row] + 0.5 * (low + high)


@_compiled
def _shifted(coefficients, times, pad, n_before, moved):  # type: ignore[no-untyped-def]
    n_after = moved.shape[1] - n_before
    for row in range(len(times)):
        start = int(np.floor(times[row]))
        known = coefficients.shape[1] - 2 * pad
        if times[row] > start:
            known -= 1
        a, b, c, d = _weights(times[row] - start)
        first, stop = max(start - n_before, 0), min(start + n_after, known)
        if first >= stop:
            continue
        near = coefficients[row, first + pad - 1 : stop + pad + 2]
        shown = moved[row, first - start + n_before : stop - start + n_before]
        for i in range(len(shown)):
            shown[i] = a * near[i] + b * near[i + 1] + c * near[i + 2] + d * near[i + 3]


def crossings(
    coefficients: Values, before: Places, pad: int, levels: Values, bisections: int
) -> Values:
    """Time, in samples, at which each spline reaches its level after sample `before`."""
    times = np.empty(len(levels))
    _crossings(coefficients, before, pad, levels, bisections, times)
    return times


def shifted(
    coefficients: Values, times: Values, pad: int, n_before: int, n_after: int
) -> Values:
    """Each spline from `n_before` samples before its time; NaN outside the record."""
    moved = np.full((len(times), n_before + n_after), np.nan)
    _shifted(coefficients, times, pad, n_before, moved)
    return moved
