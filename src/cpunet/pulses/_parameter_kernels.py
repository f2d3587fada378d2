"""Compiled loops of the current amplitude: several pulses in, their numbers out.

Each step of dspeed's moving windows depends on the one before, so a single pulse leaves most of
a processor idle.  Here each step of the current amplitude is done for `LANES` pulses at once.
All its values are float32 and result from the same operations in the same order as in dspeed's
``upsampler`` and ``moving_window_multi``, so the results are equal to the last bit.

All sums of the other parameters are float64.  An undefined value is NaN and never raises an
exception.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cpunet.kernels import kernel

LANES = 32

_compiled: Any = kernel(error_model="numpy")


@_compiled
def average(values, steps, averaged):  # type: ignore[no-untyped-def]
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
def averaged_maxima(current, first, samples, upsampling, widths, ends):  # type: ignore[no-untyped-def]
    """Maximum of the averaged current of each pulse in the `samples` samples from `first` on.

    Parameters
    ----------
    current
        Float32, shape ``(n, length - 1)``.
    first, samples
        First sample that is averaged, shape ``(n,)``, and number of averaged samples.
    upsampling
        Steps per sample.
    widths
        Widths of the successive moving averages in steps.
    ends
        Steps at each end that are excluded from the search.

    Returns
    -------
    numpy.ndarray
        Float32, shape ``(n,)``; NaN if a searched value is NaN.
    """
    maxima = np.empty(len(current), np.float32)
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
        for width in widths:
            average(values, width, averaged)
            values, averaged = averaged, values
        highest[:] = values[ends]
        for i in range(ends, fine - ends):
            for lane in range(LANES):
                # a NaN remains
                if not values[i, lane] <= highest[lane]:
                    highest[lane] = values[i, lane]
        for lane in range(min(LANES, n - begin)):
            maxima[begin + lane] = highest[lane]
    return maxima
