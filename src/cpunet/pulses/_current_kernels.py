"""Compiled loops of the current amplitude: dspeed's moving windows, several pulses at once.

Each step of a moving window waits for the one before, so a single pulse leaves most of a
processor idle.  Here the same steps of `LANES` pulses are done together.  Every value is
float32 and the result of the same operations in the same order as in dspeed's ``upsampler`` and
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

    The windows look back and ahead in turn: on reversed values, back is ahead.
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
                row = min(begin + lane, n - 1)  # the last pulse again where there are no more
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
                # a NaN stays
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
    """Differences of neighbouring samples, and the place of the largest of each pulse.

    A pulse with a NaN has a current of NaN.
    """
    n, length = waveforms.shape
    current, steepest = np.empty((n, length - 1), np.float32), np.empty(n, np.int64)
    _currents(waveforms, current, steepest)
    return current, steepest


def maxima_elsewhere(
    current: FloatArray, first: npt.NDArray[np.int64], samples: int
) -> FloatArray:
    """Largest current of each pulse outside the `samples` from its `first` one."""
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
    """Maximum of the averaged current among the `samples` from the `first` one of each pulse.

    Parameters
    ----------
    current
        Float32, shape ``(n, length - 1)``.
    first, samples
        Samples that are averaged: the first, shape ``(n,)``, and how many.
    upsampling
        Steps per sample.
    steps, averages
        Width of a moving average in steps, and how many follow each other.
    ends
        Steps at either end that are left out of the search.

    Returns
    -------
    numpy.ndarray
        Float64, shape ``(n,)``; NaN where a value of the search is.
    """
    maxima = np.empty(len(current), np.float32)
    _maxima(current, first, samples, upsampling, steps, averages, ends, maxima)
    return maxima.astype(float)
