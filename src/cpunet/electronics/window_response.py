"""Linear responses applied to windows: a kernel on the current, then the decay.

A window is padded before the response is applied. No charge moves before the window, and all is
collected by its end, so the current is zero on both sides. The padding holds the parts of the
response outside the window and allows the window to be cut again after a later alignment.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.signal

from cpunet.electronics.finishing import PADDING_BEFORE, blocks, record_length
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import tail_slope

Values = npt.NDArray[np.float64]
Spectrum = npt.NDArray[np.complex128]

MIN_PULSES = 50  # of either dataset, for a fit
TAIL_SHARE = 0.75  # of the samples after the alignment: 300 of 400, as in the paper


def currents(windows: FloatArray) -> Values:
    """Charge collected per sample over the whole record, shape ``(n, record)``."""
    n, length = windows.shape
    record = np.zeros((n, record_length(length)))
    record[:, PADDING_BEFORE : PADDING_BEFORE + length] = np.diff(
        windows.astype(float), axis=1, prepend=0.0
    )
    return record


def integrated(current: Values, tail_slope_per_ms: float, dt_ns: float) -> Values:
    r"""Integrate currents to charge pulses, where each step decays exponentially.

    .. math:: s_j = e^{\lambda \Delta t} s_{j-1} + x_j

    Parameters
    ----------
    current
        Charge collected per sample, shape ``(n, samples)``.
    tail_slope_per_ms
        Logarithmic slope :math:`\lambda` of the tail in 1/ms, negative for a decay.
    dt_ns
        Sampling period :math:`\Delta t` in ns.

    Examples
    --------
    >>> charge = integrated(np.array([[0.0, 1.0, 0.0, 0.0]]), -20.0, 50_000.0)
    >>> charge.round(3).tolist()  # a decay time of 50 us
    [[0.0, 1.0, 0.368, 0.135]]
    """
    kept = np.exp(tail_slope_per_ms * dt_ns * 1e-6)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -kept], current, axis=1), float)


def respond(
    windows: FloatArray, transfer: Spectrum, tail_slope_per_ms: float, dt_ns: float
) -> FloatArray:
    """Apply a kernel and a decay to windows.

    Parameters
    ----------
    windows
        Simulated pulses, shape ``(n, length)``.
    transfer
        Transfer function of the kernel at the frequencies of the record.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms, negative for a decay.
    dt_ns
        Sampling period in ns.

    Returns
    -------
    numpy.ndarray
        Records, float32, shape ``(n, record_length(length))``.
    """
    length = record_length(windows.shape[1])
    records = np.empty((len(windows), length), np.float32)
    for rows in blocks(len(windows)):
        spectrum = scipy.fft.rfft(currents(windows[rows]), axis=1) * transfer
        current = scipy.fft.irfft(spectrum, length, axis=1)
        records[rows] = integrated(current, tail_slope_per_ms, dt_ns)
    return records


def tail_samples(length: int, align: int) -> int:
    """Number of samples at the end of a window that contain only the decay."""
    return max(3, int(TAIL_SHARE * (length - align)))


def fitted_tail_slope(data: FloatArray, dt_ns: float, align: int) -> float:
    """Median logarithmic slope of the tails, in 1/ms.

    Raises
    ------
    CpunetError
        If no tail is positive.
    """
    slopes = tail_slope(data, dt_ns, tail_samples(data.shape[1], align))
    slopes = slopes[np.isfinite(slopes)]
    if not slopes.size:
        raise CpunetError("no measured pulse has a positive tail; check their polarity")
    return float(np.median(slopes))


def without_decay(
    data: FloatArray, tail_slope_per_ms: float, dt_ns: float, align: int
) -> Values:
    r"""Undo the decay (pole-zero correction) and scale the pulses to unit height.

    .. math:: x_j = \sum_{k \le j} \left(s_k - e^{\lambda \Delta t} s_{k-1}\right)

    with the logarithmic slope :math:`\lambda` of the tail.

    Parameters
    ----------
    data
        Windows of shape ``(n, length)`` with the baseline at 0.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    dt_ns
        Sampling period in ns.
    align
        Sample at which the windows are aligned.

    Examples
    --------
    An exponential decay becomes a step.

    >>> decay = np.r_[np.zeros(10), np.exp(-np.arange(30) * 0.016 / 50)]  # 50 us
    >>> without_decay(decay[np.newaxis], -20.0, 16.0, 10)[0, [9, 10, 39]].round(6).tolist()
    [0.0, 1.0, 1.0]
    """
    kept = np.exp(tail_slope_per_ms * dt_ns * 1e-6)
    current = data.astype(float)
    current[:, 1:] -= kept * data[:, :-1]
    steps = np.cumsum(current, axis=1)
    heights = steps[:, -tail_samples(data.shape[1], align) :].mean(axis=1, keepdims=True)
    return np.asarray(steps / heights, float)


def require_enough(sim: FloatArray, data: FloatArray) -> None:
    """Raise a `CpunetError` unless a response can be fitted to the two datasets."""
    for side, windows in (("simulated", sim), ("measured", data)):
        if len(windows) < MIN_PULSES:
            raise CpunetError(
                f"{len(windows)} {side} pulses; give {MIN_PULSES} or more to fit a response to"
            )
