"""Compiled loops of the current amplitude: dspeed's moving windows, several pulses at once.

Each step of a moving window depends on the one before, so a single pulse leaves most of a
processor idle.  Here each step is done for `LANES` pulses at once.  All values are float32 and
result from the same operations in the same order as in dspeed's ``upsampler`` and
``moving_window_multi``, so the results are equal to the last bit.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel
from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]

LANES = 32

_compiled: Any = kernel(error_model="numpy")


@_compiled
def _window(values, steps, averaged):  # type: ignore[no-untyped-def]
    """Mean of each value and the `steps` - 1 before it, in reverse order.

    The windows alternate between looking back and ahead: on reversed values, back is ahead.
    """
    width, last, total = np.float32(steps), len(values) - 1, values[0].copy()
    averaged[last] = total
    for i in range(1, steps):
        for lane in range(len(total)):
            total[lane] += (values[i, lane] - values[0, lane]) / width
            averaged[last - i, lane] = total[lane]
    leaving = values[: len(values) - steps]
    for i in range(len(leaving)):
        for lane in range(len(total)):
            total[lane] += (values[i + steps, lane] - leaving[i, lane]) / width
            averaged[last - steps - i, lane] = total[lane]


@_compiled
def _maxima(current, first, samples, upsampling, steps, averages, ends, maxima):  # type: ignore[no-untyped-def]
    n, fine = len(current), (samples - 1) * upsampling
    values = np.empty((fine, LANES), np.float32)
    averaged = np.empty((fine, LANES), np.float32)
    highest = np.empty(LANES, np.float32)
    for begin in range(0, n, LANES):
        for sample in range(samples):
            for lane in range(LANES):
                row = min(begin + lane, n - 1)  # repeat the last pulse in unused lanes
                highest[lane] = current[row, first[row] + sample]
            # dspeed centres each sample on its steps
            start = sample * upsampling - upsampling // 2
            for i in range(max(start, 0), min(start + upsampling, fine)):
                values[i] = highest
        for _ in range(averages):
            _window(values, steps, averaged)
            values, averaged = averaged, values
        highest[:] = values[ends]
        for i in range(ends, fine - ends):
            for lane in range(LANES):
                # a NaN is kept
                if not values[i, lane] <= highest[lane]:
                    highest[lane] = values[i, lane]
        for lane in range(min(LANES, n - begin)):
            maxima[begin + lane] = highest[lane]


@_compiled
def _currents(waveforms, current, steepest):  # type: ignore[no-untyped-def]
    samples = waveforms.shape[1] - 1
    for row in range(len(waveforms)):
        unknown = False
        best = 0
        for i in range(samples):
            current[row, i] = waveforms[row, i + 1] - waveforms[row, i]
            unknown |= math.isnan(waveforms[row, i])
        unknown |= math.isnan(waveforms[row, samples])
        if unknown:
            current[row] = math.nan
        for i in range(samples):
            if current[row, i] > current[row, best]:
                best = i
        steepest[row] = best


@_compiled
def _elsewhere(current, first, samples, highest):  # type: ignore[no-untyped-def]
    for row in range(len(current)):
        highest[row] = -math.inf
        for i in range(current.shape[1]):
            inside = first[row] <= i < first[row] + samples
            if not (inside or current[row, i] <= highest[row]):
                highest[row] = current[row, i]


def currents(waveforms: FloatArray) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Differences of neighbouring samples, and the index of the largest one of each pulse.

    A pulse with a NaN has a current of NaN.
    """
    n, length = waveforms.shape
    current, steepest = np.empty((n, length - 1), np.float32), np.empty(n, np.int64)
    _currents(waveforms, current, steepest)
    return current, steepest


def maxima_elsewhere(
    current: FloatArray, first: npt.NDArray[np.int64], samples: int
) -> FloatArray:
    """Largest current of each pulse outside the `samples` samples that start at `first`."""
    highest = np.empty(len(current), np.float32)
    _elsewhere(current, first, samples, highest)
    return highest


def averaged_maxima(
    current: FloatArray,
    first: npt.NDArray[np.int64],
    samples: int,
    *,
    upsampling: int,
    steps: int,
    averages: int,
    ends: int,
) -> Values:
    """Maximum of the averaged current of each pulse in the `samples` samples from `first` on.

    Parameters
    ----------
    current
        Float32, shape ``(n, length - 1)``.
    first, samples
        First sample that is averaged, shape ``(n,)``, and number of averaged samples.
    upsampling
        Steps per sample.
    steps, averages
        Width of the moving average in steps, and number of successive averages.
    ends
        Steps at each end that are excluded from the search.

    Returns
    -------
    numpy.ndarray
        Float64, shape ``(n,)``; NaN if a searched value is NaN.
    """
    maxima = np.empty(len(current), np.float32)
    _maxima(current, first, samples, upsampling, steps, averages, ends, maxima)
    return maxima.astype(float)
