"""Linear responses applied to windows: kernel on the current, then the decay.

A window is extended before the response acts: no charge has moved before it, and all
has been collected after it.  In the current both are zeros, so the extension costs
nothing but room: for what the kernel adds before and after, and for the window that is
cut out again around a later alignment.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.signal

from cpunet.electronics.finishing import blocks
from cpunet.electronics.rivals.base import Values
from cpunet.pulses.container import FloatArray

Spectrum = npt.NDArray[np.complex128]

# Samples of room; a window of 800 becomes a record of 1400, a fast length of the FFT.
ROOM_BEFORE = 200
ROOM_AFTER = 400


def record_length(window: int) -> int:
    """Samples of the record that a window of so many becomes."""
    return ROOM_BEFORE + window + ROOM_AFTER


def currents(windows: FloatArray) -> Values:
    """Charge collected per sample over the whole record, shape ``(n, record)``."""
    n, length = windows.shape
    record = np.zeros((n, record_length(length)))
    record[:, ROOM_BEFORE : ROOM_BEFORE + length] = np.diff(
        windows.astype(float), axis=1, prepend=0.0
    )
    return record


def frequencies_mhz(length: int, dt_ns: float) -> Values:
    """Frequencies of the spectrum of so many samples, in MHz."""
    return np.asarray(scipy.fft.rfftfreq(length, dt_ns * 1e-3), float)


def filtered(current: Values, transfer: Spectrum) -> Values:
    """Currents after a kernel given by its transfer function over the record."""
    spectrum = scipy.fft.rfft(current, axis=1) * transfer
    return np.asarray(scipy.fft.irfft(spectrum, current.shape[1], axis=1), float)


def integrated(current: Values, tail_slope_per_ms: float, dt_ns: float) -> Values:
    """Charge pulses of currents, each step decaying with the slope of its logarithm."""
    kept = np.exp(tail_slope_per_ms * dt_ns * 1e-6)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -kept], current, axis=1), float)


def respond(
    windows: FloatArray, transfer: Spectrum, tail_slope_per_ms: float, dt_ns: float
) -> FloatArray:
    """Response of a kernel and a decay to windows.

    Parameters
    ----------
    windows
        Simulated pulses, shape ``(n, length)``.
    transfer
        Transfer function of the kernel at the frequencies of the record.
    tail_slope_per_ms
        Slope of the logarithm of the tail in 1/ms, negative for a decay.
    dt_ns
        Sampling period in ns.

    Returns
    -------
    numpy.ndarray
        Float32, shape ``(n, record_length(length))``.
    """
    records = np.empty((len(windows), record_length(windows.shape[1])), np.float32)
    for rows in blocks(len(windows)):
        current = filtered(currents(windows[rows]), transfer)
        records[rows] = integrated(current, tail_slope_per_ms, dt_ns)
    return records
