"""Spectra of baselines, also where a baseline is too short to show them."""

from __future__ import annotations

import numpy as np
import scipy.fft
import scipy.ndimage
import scipy.optimize

from cpunet.electronics.exponentials import FloatArray as Values

# Below the third frequency of a baseline its mean and the window's leakage hide the
# spectrum; there it follows from how the noise drifts apart over the baseline's length.
FIRST_CLEAN_BIN, RECORD_SAMPLES = 3, 8192
# A line stands out this much from the median of so many bins to either side, and a window
# spreads it over so many.
LINE_HEIGHT, LINE_AROUND, LINE_HALF_WIDTH = 3.0, 10, 2
CORNERS, LAGS = 8, 40  # of the slow part's Lorentzians; at which the drift is compared


def spectrum(baselines: Values) -> tuple[Values, Values]:
    """Mean square per sample and frequency bin of a set of baselines.

    Parameters
    ----------
    baselines
        Shape ``(n, samples)``, any level.

    Returns
    -------
    tuple of array
        The continuum and the lines, at the frequencies of a real FFT of `RECORD_SAMPLES`:
        their sum is the density.  A line, narrower than the baselines resolve, is one bin.
    """
    density = _periodogram(baselines)
    continuum, lines = _without_lines(density, baselines.shape[1])
    return _with_slow_part(continuum, lines, _structure_function(baselines)), lines


def _without_lines(density: Values, samples: int) -> tuple[Values, Values]:
    """A periodogram without its lines, and the lines on the grid of the records."""
    around = scipy.ndimage.median_filter(density, 2 * LINE_AROUND + 1, mode="nearest")
    lines = np.zeros(RECORD_SAMPLES // 2 + 1)
    continuum = density.copy()
    bins = np.arange(len(density))
    local = scipy.ndimage.maximum_filter1d(density, 2 * LINE_HALF_WIDTH + 1) == density
    for peak in np.flatnonzero(local & (density > LINE_HEIGHT * around)):
        if not FIRST_CLEAN_BIN < peak < len(density) - LINE_HALF_WIDTH:
            continue
        near = slice(peak - LINE_HALF_WIDTH, peak + LINE_HALF_WIDTH + 1)
        excess = np.maximum(density[near] - around[near], 0)
        centre = (excess @ bins[near]) / excess.sum() / samples
        # the bins of the periodogram are wider than those of the records
        lines[round(centre * RECORD_SAMPLES)] += excess.sum() * RECORD_SAMPLES / samples
        continuum[near] = np.minimum(continuum[near], around[near])
    return continuum, lines


def _periodogram(baselines: Values) -> Values:
    samples = baselines.shape[1]
    window = np.hanning(samples + 1)[:-1]
    centred = (baselines - baselines.mean(axis=1, keepdims=True)) * window
    power = np.abs(scipy.fft.rfft(centred, axis=1)) ** 2
    return np.asarray(power.mean(axis=0) / (window @ window), float)


def _structure_function(baselines: Values) -> Values:
    """Half the mean square difference of samples 0, 1, 2 ... apart.

    Unlike a spectrum it needs no mean to be taken off, so that nothing is lost of noise
    slower than the baseline.
    """
    n, samples = baselines.shape
    padded = scipy.fft.next_fast_len(2 * samples, real=True)
    centred = baselines - baselines.mean(axis=1, keepdims=True)
    power = np.zeros(padded // 2 + 1)
    for rows in range(0, n, 512):
        power += (np.abs(scipy.fft.rfft(centred[rows : rows + 512], padded)) ** 2).sum(axis=0)
    products = scipy.fft.irfft(power, padded)[:samples]
    squares = np.cumsum((centred**2).sum(axis=0))
    lag = np.arange(samples)
    # the squares of the samples that have a partner later, and of those that have one earlier
    left, right = squares[samples - 1 - lag], squares[-1] - np.r_[0, squares[:-1]]
    return np.asarray((0.5 * (left + right) - products) / (n * (samples - lag)), float)


def _with_slow_part(density: Values, lines: Values, drift: Values) -> Values:
    """The spectrum down to the frequencies of `RECORD_SAMPLES`.

    Parameters
    ----------
    density
        Periodogram of the baselines without its lines.
    lines
        These, at the frequencies of the result.
    drift
        Structure function of the baselines.

    Returns
    -------
    array
        Density at the frequencies of a real FFT of `RECORD_SAMPLES`: as measured from
        `FIRST_CLEAN_BIN` on, and rising from there towards 0 by a sum of Lorentzians, none
        of them negative, whose structure function comes closest to `drift`.
    """
    samples = len(drift)
    frequency = np.arange(RECORD_SAMPLES // 2 + 1) / RECORD_SAMPLES
    known = np.arange(len(density)) / samples
    join = known[FIRST_CLEAN_BIN]
    fast = np.interp(frequency, known[FIRST_CLEAN_BIN:], density[FIRST_CLEAN_BIN:])
    corners = np.geomspace(2 / RECORD_SAMPLES, join, CORNERS)[:, np.newaxis]
    slow = 1 / (1 + (frequency / corners) ** 2) - 1 / (1 + (join / corners) ** 2)
    slow = np.maximum(slow, 0)
    lags = np.unique(np.geomspace(4, 0.9 * samples, LAGS).astype(int))
    # both signs of the frequency; a density of 1 is a mean square of 1
    apart = 2 * (1 - np.cos(2 * np.pi * lags[:, np.newaxis] * frequency)) / RECORD_SAMPLES
    weights = 1 / drift[lags]
    rest = (drift[lags] - apart @ (fast + lines)) * weights
    heights, _ = scipy.optimize.nnls((apart @ slow.T) * weights[:, np.newaxis], rest)
    return np.asarray(fast + heights @ slow, float)
