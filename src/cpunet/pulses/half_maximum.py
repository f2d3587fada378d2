"""Where pulses cross half of their maximum, and pulses shifted by parts of a sample.

Both use the cubic spline through the samples: linear interpolation would smooth the edge.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]

BISECTIONS = 30  # of one sample: a precision of 1e-9
PAD = 8  # samples of the edge value; the effect of the spline's end falls by 3.7 per sample


class Splines:
    """Cubic splines through pulses, beyond their ends constant.

    Parameters
    ----------
    waveforms
        Finite pulses, shape ``(n, samples)``.
    """

    def __init__(self, waveforms: FloatArray | Values) -> None:
        from scipy.ndimage import spline_filter1d

        padded = np.pad(waveforms.astype(float), ((0, 0), (PAD, PAD)), mode="edge")
        self.coefficients: Values = spline_filter1d(padded, order=3, axis=1)

    def crossing(self, before: npt.NDArray[np.intp], level: Values) -> Values:
        """Time, in samples, at which each pulse reaches `level` after sample `before`."""
        columns = before[:, np.newaxis] + PAD + np.arange(-1, 3)
        local = np.take_along_axis(self.coefficients, columns, axis=1)
        low, high = np.zeros(len(level)), np.ones(len(level))
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            under = (_weights(middle) * local).sum(axis=1) < level
            low, high = np.where(under, middle, low), np.where(under, high, middle)
        return before + 0.5 * (low + high)

    def shifted(self, times: Values, n_before: int, n_after: int) -> Values:
        """Pulses from `n_before` samples before a time of each until `n_after` after it.

        Returns
        -------
        numpy.ndarray
            Shape ``(n, n_before + n_after)``; NaN outside the record.
        """
        start = np.floor(times).astype(int)
        end = self.coefficients.shape[1] - 2 * PAD - (times > start)
        moved = np.full((len(times), n_before + n_after), np.nan)
        # row by row: fancy indexing of every sample would take ten times as long
        for row, curve, at, known, weights in zip(
            moved, self.coefficients, start, end, _weights(times - start), strict=True
        ):
            first, stop = max(at - n_before, 0), min(at + n_after, known)
            if first < stop:
                near = curve[first + PAD - 1 : stop + PAD + 2]
                row[first - at + n_before : stop - at + n_before] = np.correlate(near, weights)
        return moved


def last_below_half(
    waveforms: FloatArray | Values,
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.intp]]:
    """Find the last upward crossing of half of the maximum before the maximum.

    Parameters
    ----------
    waveforms
        Pulses with the baseline at 0, shape ``(n, samples)``.

    Returns
    -------
    tuple of numpy.ndarray
        Mask of the finite pulses with such a crossing, and the sample before it.
    """
    length = waveforms.shape[1]
    finite = np.isfinite(waveforms).all(axis=1)
    top = np.where(finite, waveforms.argmax(axis=1), 0)
    height = waveforms[np.arange(len(waveforms)), top]
    below = waveforms < 0.5 * height[:, np.newaxis]
    below &= np.arange(length) < top[:, np.newaxis]
    last = length - 1 - below[:, ::-1].argmax(axis=1)
    return finite & (height > 0) & below.any(axis=1), last


def _weights(fraction: Values) -> Values:
    """Weights ``(n, 4)`` of the coefficients at -1, 0, 1, 2 for a time in 0 … 1."""
    t, s = fraction, 1 - fraction
    return np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], axis=1) / 6
