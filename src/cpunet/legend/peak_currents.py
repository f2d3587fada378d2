"""Currents aligned at their maxima: templates of the libraries of production simulations.

The current of a template is averaged three times over 48 ns, like that of A in A/E, and
shifted so that its maximum is at sample `PEAK`.  The shift includes the fraction of a sample,
since half a nanosecond already changes the summed current of two sites.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from cpunet.kernels import kernel
from cpunet.pulses.container import FloatArray

WINDOW, WINDOWS = 48, 3  # length of a moving average in ns, and number of averages
PEAK, LENGTH = 1000, 4001  # sample of the maximum, and length of a template in ns
MODE_BINS = 1000

Values = npt.NDArray[np.float64]


def currents_about_peak(charge: FloatArray) -> tuple[npt.NDArray[np.float32], Values]:
    """Average the currents, and shift their maxima to sample `PEAK`.

    Parameters
    ----------
    charge
        Charge sampled every nanosecond, 0 before the first sample, shape ``(n, samples)``.

    Returns
    -------
    currents
        Currents in units of the charge per ns, shape ``(n, LENGTH)``; 0 outside the record,
        rows of NaN for templates that contain NaN, have no maximum above 0, or have fewer
        than 3 samples.
    times_ns
        Times of the maxima after the first sample, shape ``(n,)``, including the delay of the
        backward averages, which is the same for all templates; NaN for rows of NaN.
    """
    n = len(charge)
    currents = np.full((n, LENGTH), np.nan, np.float32)
    times = np.full(n, np.nan)
    if charge.shape[1] < 3:  # no sample has two neighbours
        return currents, times
    _about_peak(np.ascontiguousarray(charge, np.float32), currents, times)
    return currents, times


def heights(currents: FloatArray) -> Values:
    """A/E of templates of unit charge, i.e. their currents at `PEAK`."""
    return np.asarray(currents[..., PEAK], np.float64)


def most_frequent(amplitudes: Values) -> float:
    """Mode of A/E as in production: centre of the fullest of 1,000 bins of the whole range.

    If all values are the same, it is their value.

    Parameters
    ----------
    amplitudes
        Finite values, at least one.

    Examples
    --------
    >>> round(most_frequent(np.array([1.0, 2.0, 2.0, 3.0])), 2)
    2.0
    """
    if np.ptp(amplitudes) == 0:  # the bins would be 0.001/ns wide, a tenth of A/E
        return float(amplitudes[0])
    counts, edges = np.histogram(amplitudes, MODE_BINS)
    highest = int(counts.argmax())
    return float(0.5 * (edges[highest] + edges[highest + 1]))


@kernel(parallel=True)
def _about_peak(
    charge: npt.NDArray[np.float32], currents: npt.NDArray[np.float32], times: Values
) -> None:
    # arrays of NaN, filled where a template has a maximum
    n, n_samples = charge.shape
    for i in prange(n):
        current = _averaged(charge[i])
        peak = 1
        for k in range(1, n_samples - 1):
            if current[k] > current[peak]:
                peak = k
        bend = current[peak - 1] - 2 * current[peak] + current[peak + 1]
        # the running sums remain NaN after a NaN
        if np.isnan(current[-1]) or not (current[peak] > 0 and bend < 0):
            continue
        time = peak + 0.5 * (current[peak - 1] - current[peak + 1]) / bend
        times[i] = time
        first = int(np.floor(time))
        f = time - first
        # cubic interpolation with the slopes of the neighbours (Catmull and Rom)
        w0 = 0.5 * f * (-1 + f * (2 - f))
        w1 = 0.5 * (2 + f * f * (3 * f - 5))
        w2 = 0.5 * f * (1 + f * (4 - 3 * f))
        w3 = 0.5 * f * f * (f - 1)
        for j in range(currents.shape[1]):
            k = first + j - PEAK
            value = 0.0
            if 1 <= k < n_samples - 2:
                value = (
                    w0 * current[k - 1]
                    + w1 * current[k]
                    + w2 * current[k + 1]
                    + w3 * current[k + 2]
                )
            currents[i, j] = value


@kernel
def _averaged(charge: npt.NDArray[np.float32]) -> Values:
    """Differences between samples after the backward averages; NaN from a NaN on."""
    n_samples = len(charge)
    current = np.empty(n_samples)
    before = 0.0
    for k in range(n_samples):
        current[k] = charge[k] - before
        before = charge[k]
    averaged = np.empty(n_samples)
    for _ in range(WINDOWS):
        total = 0.0
        for k in range(n_samples):
            total += current[k]
            if k >= WINDOW:
                total -= current[k - WINDOW]
            averaged[k] = total / WINDOW
        current, averaged = averaged, current
    return current
