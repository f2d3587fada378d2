"""Noise spectra of baselines, including frequencies that a baseline is too short for."""

from __future__ import annotations

import numpy as np
import scipy.fft
import scipy.ndimage
import scipy.optimize

from cpunet.electronics.exponentials import FloatArray as Values

# Below the third bin of a baseline, its mean and the window's leakage hide the spectrum.
# There it is inferred from the structure function over the baseline's length.
FIRST_CLEAN_BIN, RECORD_SAMPLES = 3, 8192
# A line exceeds the median of the ten bins on either side by this factor. The window spreads
# it over two bins on either side.
LINE_HEIGHT, LINE_AROUND, LINE_HALF_WIDTH = 3.0, 10, 2
CORNERS, LAGS = 8, 40  # Lorentzians of the slow part; lags at which the drift is compared


def spectrum(baselines: Values) -> tuple[Values, Values]:
    r"""Power spectrum of a set of baselines: mean square per sample and frequency bin.

    The Hann-windowed periodogram of the baselines :math:`x_j`,

    .. math:: S(\nu) = \frac{\langle |\sum_j w_j (x_j - \bar x)
        e^{-2\pi i \nu j}|^2 \rangle}{\sum_j w_j^2},

    without its lines, continued to low frequencies by a sum of Lorentzians that is fitted to
    the structure function :math:`\frac{1}{2} \langle (x_{j+k} - x_j)^2 \rangle`.

    Parameters
    ----------
    baselines
        Baselines at any level, shape ``(n, samples)``.

    Returns
    -------
    tuple of array
        Continuum and lines at the frequencies of a real FFT of `RECORD_SAMPLES`. Their sum is
        the density. A line, which the baselines do not resolve, occupies one bin.

    Examples
    --------
    The spectrum of white noise is its variance.

    >>> white = np.random.default_rng(1).normal(0, 2, size=(200, 512))
    >>> continuum, lines = spectrum(white)
    >>> bool(abs(continuum[1000:].mean() - 4) < 0.1), bool(lines.any())
    (True, False)
    """
    density = _periodogram(baselines)
    continuum, lines = _without_lines(density, baselines.shape[1])
    return _with_slow_part(continuum, lines, _structure_function(baselines)), lines


def _without_lines(density: Values, samples: int) -> tuple[Values, Values]:
    """Split a periodogram into its continuum and its lines on the grid of the records."""
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
    """Half the mean square difference of samples at lags 0, 1, 2, ...

    Unlike a spectrum it needs no subtraction of the mean. Noise slower than the baseline is
    therefore retained in full.
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
    # sums of squares over samples with a later partner, and over those with an earlier one
    left, right = squares[samples - 1 - lag], squares[-1] - np.r_[0, squares[:-1]]
    return np.asarray((0.5 * (left + right) - products) / (n * (samples - lag)), float)


def _with_slow_part(density: Values, lines: Values, drift: Values) -> Values:
    """Continue the spectrum down to the frequencies of `RECORD_SAMPLES`.

    Parameters
    ----------
    density
        Periodogram of the baselines without its lines.
    lines
        The lines at the frequencies of the result.
    drift
        Structure function of the baselines.

    Returns
    -------
    array
        Density at the frequencies of a real FFT of `RECORD_SAMPLES`. From `FIRST_CLEAN_BIN`
        upwards it is the measured one. Below, it rises towards 0 by a non-negative sum of
        Lorentzians whose structure function is closest to `drift`.
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
    # both signs of the frequency: a density of 1 is a mean square of 1
    apart = 2 * (1 - np.cos(2 * np.pi * lags[:, np.newaxis] * frequency)) / RECORD_SAMPLES
    weights = 1 / drift[lags]
    rest = (drift[lags] - apart @ (fast + lines)) * weights
    heights, _ = scipy.optimize.nnls((apart @ slow.T) * weights[:, np.newaxis], rest)
    return np.asarray(fast + heights @ slow, float)
