"""Extend prepared windows with baseline before them and their own decay after them."""

from __future__ import annotations

import numpy as np

from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import tail_slope
from cpunet.recipes.schema import PreparationConfig

# Samples of padding around a window, so that it can be cut anew if noise moves the maximum and
# delayed pulses stay within the record. A window of 800 becomes a record of 1400, a fast length
# of the FFT.
PADDING_BEFORE, PADDING_AFTER = 200, 400


def record_length(window: int) -> int:
    """Number of samples of the record that a window of `window` samples becomes."""
    return PADDING_BEFORE + window + PADDING_AFTER


def extended(
    windows: FloatArray, config: PreparationConfig, dt_ns: float, length: int, n_pre: int
) -> FloatArray:
    """Cut or extend prepared windows, with 0 before them and their fitted decay after them.

    Parameters
    ----------
    windows
        Shape (n, config.length); a row with a NaN becomes NaN.
    config
        Their preparation settings. The last `decay_fit_samples` of each determine its decay.
    dt_ns
        Sampling period in ns.
    length, n_pre
        Number of samples of the result, and number of samples before the alignment.

    Returns
    -------
    numpy.ndarray
        Float32, shape (n, length).
    """
    time = np.arange(length) - n_pre + config.samples_before  # as samples of the window
    inside = (time >= 0) & (time < config.length)
    result = np.zeros((len(windows), length), np.float32)
    result[:, inside] = windows[:, time[inside]]
    late = time >= config.length
    if late.any():
        # 0 for a tail that is not positive; a window need not be aligned
        slope = np.nan_to_num(tail_slope(windows, dt_ns, config.decay_fit_samples))
        # the mean of the last samples is the level at their centre
        since = time[late] - (config.length - 0.5 * (config.tail_samples + 1))
        end = windows[:, -config.tail_samples :].mean(axis=1)
        decay = np.exp(slope[:, np.newaxis] * dt_ns * 1e-6 * since)
        result[:, late] = end[:, np.newaxis] * decay
    result[np.isnan(windows).any(axis=1)] = np.nan
    return result


def with_room(windows: FloatArray, config: PreparationConfig, dt_ns: float) -> FloatArray:
    """Extend prepared windows to records, see `record_length`."""
    before = PADDING_BEFORE + config.samples_before
    return extended(windows, config, dt_ns, record_length(config.length), before)
