"""Where pulses cross half of their maximum, and pulses shifted by parts of a sample.

Both use the cubic spline through the samples: linear interpolation would smooth the edge.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cpunet.pulses import _half_maximum_kernels as kernels
from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]

BISECTIONS = 30  # of one sample: a precision of 1e-9
PAD = 8  # samples of the edge value; the effect of the spline's end falls 3.7-fold per sample


class Splines:
    """Cubic splines through pulses, constant beyond their ends.

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
        return kernels.crossings(self.coefficients, before, PAD, level, BISECTIONS)

    def shifted(self, times: Values, n_before: int, n_after: int) -> Values:
        """Each pulse from `n_before` samples before its time to `n_after` samples after it.

        Returns
        -------
        numpy.ndarray
            Shape ``(n, n_before + n_after)``; NaN outside the record.
        """
        return kernels.shifted(self.coefficients, times, PAD, n_before, n_after)


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
