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

from cpunet.electronics.baseline_methods.base import Values
from cpunet.electronics.extension import PADDING_BEFORE, record_length
from cpunet.electronics.finishing import blocks
from cpunet.pulses.container import FloatArray

Spectrum = npt.NDArray[np.complex128]


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
