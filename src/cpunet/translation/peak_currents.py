"""Currents about their maximum, as production simulations take the templates of a library.

The current of a template is averaged three times over 48 ns, as A of A/E is, and moved so that
its maximum is at one and the same sample.  The maximum of a smooth current lies between
samples: templates are moved by fractions of one, since half a nanosecond changes the sum of
two sites' currents.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from cpunet.kernels import kernel
from cpunet.pulses.container import FloatArray

WINDOW, WINDOWS = 48, 3  # samples of 1 ns, and how often the current is averaged over them
PEAK, LENGTH = 1000, 4001  # sample of the maximum, and samples of a template
MODE_BINS = 1000

Values = npt.NDArray[np.float64]


def currents_about_peak(charge: FloatArray) -> tuple[npt.NDArray[np.float32], Values]:
    """Averaged currents with their maximum at sample `PEAK`, and when it was.

    Parameters
    ----------
    charge
        Templates sampled every nanosecond, 0 before their first sample, shape (n, samples).

    Returns
    -------
    currents
        In units of the charge per ns, shape (n, `LENGTH`): 0 where nothing was sampled.
        Rows of NaN for templates that hold NaN or have no maximum above 0.
    times_ns
        Of the maxima, after the first sample and late by the windows, which look back only:
        the same for all templates.  NaN where the row is.
    """
    n = len(charge)
    currents = np.empty((n, LENGTH), np.float32)
    times = np.empty(n)
    _about_peak(np.ascontiguousarray(charge, np.float32), currents, times)
    return currents, times


def heights(currents: FloatArray) -> Values:
    """A/E of templates of unit charge: their currents at the maximum."""
    return np.asarray(currents[..., PEAK], np.float64)


def most_frequent(amplitudes: Values) -> float:
    """Mode of A/E as production takes it: the fullest of a thousand bins from least to most.

    Parameters
    ----------
    amplitudes
        Finite numbers, at least one.

    Examples
    --------
    >>> round(most_frequent(np.array([1.0, 2.0, 2.0, 3.0])), 2)
    2.0
    """
    counts, edges = np.histogram(amplitudes, MODE_BINS)
    highest = int(counts.argmax())
    return float(0.5 * (edges[highest] + edges[highest + 1]))


@kernel(parallel=True)
def _about_peak(
    charge: npt.NDArray[np.float32], currents: npt.NDArray[np.float32], times: Values
) -> None:
    n, n_samples = charge.shape
    for i in prange(n):
        current = _averaged(charge[i])
        peak = 1
        for k in range(1, n_samples - 1):
            if current[k] > current[peak]:
                peak = k
        bend = current[peak - 1] - 2 * current[peak] + current[peak + 1]
        if not (current[peak] > 0 and bend < 0):
            currents[i] = np.nan
            times[i] = np.nan
            continue
        time = peak + 0.5 * (current[peak - 1] - current[peak + 1]) / bend
        times[i] = time
        first = int(np.floor(time))
        f = time - first
        # a cubic through the values, with the slopes of their neighbours (Catmull and Rom)
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
    """Differences from sample to sample, averaged over the last ones; NaN if any is."""
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
