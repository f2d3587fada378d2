"""Where pulses cross half of their maximum, and pulses shifted by parts of a sample.

Both use the cubic spline through the samples: linear interpolation would smooth the edge.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.kernels import kernel
from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]

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


BISECTIONS = 30  # of one sample: a precision of 1e-9
BLOCK = 512  # pulses per block: bounds memory
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
        times = np.empty(len(level))
        _crossings(self.coefficients, before, PAD, level, BISECTIONS, times)
        return times

    def shifted(self, times: Values, n_before: int, n_after: int) -> Values:
        """Each pulse from `n_before` samples before its time to `n_after` samples after it.

        Returns
        -------
        numpy.ndarray
            Shape ``(n, n_before + n_after)``; NaN outside the record.
        """
        moved = np.full((len(times), n_before + n_after), np.nan)
        _shifted(self.coefficients, times, PAD, n_before, moved)
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
    finite = np.isfinite(waveforms).all(axis=1)
    top = np.where(finite, waveforms.argmax(axis=1), 0)
    height = waveforms[np.arange(len(waveforms)), top]
    there, last = last_below(waveforms, top, 0.5 * height)
    return finite & (height > 0) & there, last


def last_below(
    waveforms: FloatArray | Values, top: npt.NDArray[np.intp], level: FloatArray | Values
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.intp]]:
    """Whether each pulse is below a level before its `top`, and the last such sample."""
    below = waveforms < level[:, np.newaxis]
    below &= np.arange(waveforms.shape[1]) < top[:, np.newaxis]
    there = np.asarray(below.any(axis=1))
    return there, waveforms.shape[1] - 1 - below[:, ::-1].argmax(axis=1)


def align_half_maximum(waveforms: FloatArray, n_before: int, n_after: int) -> FloatArray:
    """Shift each pulse so that it crosses half of its maximum at sample `n_before`.

    The crossing is the last upward one before the maximum, searched backward from it.
    Its time and the shifted pulse are evaluated with the pulse's cubic spline; linear
    interpolation would smooth the edge.  The maximum is the largest sample of the pulse.
    Noise of relative RMS s on a flat top raises it by 2–3 s, and the level by 1–1.5 s.

    Parameters
    ----------
    waveforms
        Pulses of shape ``(n, length)`` with the baseline at 0.
    n_before, n_after
        Number of samples before the crossing, and from it on.

    Returns
    -------
    numpy.ndarray
        Float32, shape ``(n, n_before + n_after)``; NaN outside the record, and all NaN
        for a pulse without such a crossing or with a value that is not finite.

    Raises
    ------
    CpunetError
        If `waveforms` is not of shape (pulses, samples), or a pulse has fewer than 2 samples.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(100)
    >>> pulses = np.array([1 / (1 + np.exp((t0 - time) / 3)) for t0 in (40.3, 51.8)])
    >>> align_half_maximum(pulses, 2, 3).round(3)
    array([[0.339, 0.417, 0.5  , 0.583, 0.661],
           [0.339, 0.417, 0.5  , 0.583, 0.661]], dtype=float32)
    """
    require_pulses(waveforms)
    aligned = np.empty((len(waveforms), n_before + n_after), np.float32)
    for first in range(0, len(waveforms), BLOCK):
        rows = slice(first, first + BLOCK)
        aligned[rows] = aligned_block(waveforms[rows], n_before, n_after)
    return aligned


def require_pulses(waveforms: FloatArray) -> None:
    """Raise a `CpunetError` unless an array has the shape (pulses, samples)."""
    if waveforms.ndim != 2 or waveforms.shape[1] < 2:
        raise CpunetError(
            f"waveforms have shape {waveforms.shape}; "
            "expected (pulses, samples) with 2 samples or more"
        )


def aligned_block(waveforms: FloatArray, n_before: int, n_after: int) -> Values:
    """One block of `align_half_maximum`, in float64."""
    moved = np.full((len(waveforms), n_before + n_after), np.nan)
    usable, before = last_below_half(waveforms)
    if usable.any():
        pulses = waveforms[usable]
        splines = Splines(pulses)
        level = 0.5 * pulses.max(axis=1).astype(float)
        times = splines.crossing(before[usable], level)
        moved[usable] = splines.shifted(times, n_before, n_after)
    return moved
