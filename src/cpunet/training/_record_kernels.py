"""Compiled loops that align records and read their tail slopes and current amplitudes.

They align at half maximum, where a pulse is steepest.  Both sides go through the same code, so
that its effects on a pulse cancel.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from cpunet.kernels import kernel


class RecordWindow(NamedTuple):
    """Where a record is read, as passed to the compiled loops.

    Parameters
    ----------
    level, last
        Half of the maximum, and the sample from which its crossing is searched for backward.
    before, after
        Samples of the aligned window on either side of the crossing.
    base_first, base_stop, level_samples, tail_level
        Range of samples before the crossing whose mean becomes 0, number of samples at the
        window's end whose mean becomes the level, and the level.
    tail, fit_samples
        First sample of the tail from the crossing, and number of samples of its slope.
    edge
        Samples on either side of the crossing that contain the steepest point.
    dt_ns
        Sampling period in ns.
    """

    level: float
    last: int
    before: int
    after: int
    base_first: int
    base_stop: int
    level_samples: int
    tail_level: float
    tail: int
    fit_samples: int
    edge: int
    dt_ns: float


FAST = {"nnan", "nsz", "reassoc", "contract"}  # where all numbers are finite


@kernel(error_model="numpy", fastmath=FAST)
def _mean(record: Any, first: int, stop: int) -> Any:  # pragma: no cover - compiled
    """Mean over a range of samples; edge values are repeated beyond the record."""
    total, n = 0.0, len(record)
    for i in range(max(first, 0), min(stop, n)):
        total += record[i]
    total += record[0] * max(min(stop, 0) - first, 0)
    total += record[n - 1] * max(stop - max(first, n), 0)
    return total / (stop - first)


@kernel(error_model="numpy")
def _crossing(record: Any, level: float, last: int) -> Any:  # pragma: no cover - compiled
    """Time of the last upward crossing before `last`, and the sample before it."""
    before = min(last, len(record) - 1) - 1
    while before > 0 and not record[before] < level:
        before -= 1
    low, high = record[before], record[before + 1]
    return before + (level - low) / max(high - low, 1e-6), before


@kernel(error_model="numpy", fastmath=FAST)
def _slope(tail: Any, logs: Any) -> Any:  # pragma: no cover - compiled
    """Slope per sample of the logarithm."""
    n = len(tail)
    for i in range(n):
        logs[i] = math.log(max(tail[i], np.float32(1e-3)))
    moment, centre = 0.0, 0.5 * (n - 1)
    for i in range(n):
        moment += (i - centre) * logs[i]
    return moment / (n * (n * n - 1.0) / 12.0)


@kernel(error_model="numpy")
def _tail_slope(
    record: Any, start: int, w: RecordWindow, tail: Any, logs: Any
) -> Any:  # pragma: no cover - compiled
    """Tail slope of the window that the preparation would cut."""
    for i in range(w.fit_samples):
        tail[i] = record[min(start + i, len(record) - 1)]
    return _slope(tail, logs)


@kernel(error_model="numpy", fastmath=FAST)
def _amplitude(current: Any, first: int, stop: int, weights: Any) -> Any:  # pragma: no cover
    """Largest weighted mean of the current on its fine grid, its centre and phase."""
    phases, width = weights.shape
    half, n = width // 2, len(current)
    best, at, best_phase = np.float32(-np.inf), first, 0
    for centre in range(first, stop):
        for phase in range(phases):
            total = np.float32(0)
            if centre - half >= 0 and centre + half < n:
                for k in range(width):
                    total += weights[phase, k] * current[centre - half + k]
            else:
                for k in range(width):
                    total += weights[phase, k] * current[min(max(centre - half + k, 0), n - 1)]
            if total > best:
                best, at, best_phase = total, centre, phase
    return best, at, best_phase


@kernel(error_model="numpy", fastmath=FAST)
def _normalise(
    record: Any, sample: int, w: RecordWindow
) -> None:  # pragma: no cover - compiled
    base = _mean(record, sample - w.base_first, sample - w.base_stop)
    tail = _mean(record, sample + w.after - w.level_samples, sample + w.after) - base
    factor, offset = np.float32(w.tail_level / tail), np.float32(base)
    for i in range(len(record)):
        record[i] = (record[i] - offset) * factor


@kernel(error_model="numpy", fastmath=FAST)
def _window(
    record: Any, time: float, w: RecordWindow, aligned: Any
) -> None:  # pragma: no cover - compiled
    """Window of the record around a time, by linear interpolation between samples."""
    start = math.floor(time)
    fraction, n = np.float32(time - start), len(record)
    first = int(start) - w.before
    if first >= 0 and first + w.before + w.after < n:
        for i in range(w.before + w.after):
            low = record[first + i]
            aligned[i] = low + fraction * (record[first + i + 1] - low)
    else:
        for i in range(w.before + w.after):
            low = record[min(max(first + i, 0), n - 1)]
            high = record[min(max(first + i + 1, 0), n - 1)]
            aligned[i] = low + fraction * (high - low)


@kernel(error_model="numpy")
def read_records(
    records: Any,
    w: RecordWindow,
    weights: Any,
    aligned: Any,
    slopes: Any,
    amplitudes: Any,
    places: Any,
) -> None:  # pragma: no cover - compiled
    """Align and read each record; the records are normalised in place.

    Parameters
    ----------
    records
        Float32, shape (pulses, samples).
    w, weights
        Where to read, and the weights of the current amplitude (phases, samples).
    aligned, slopes, amplitudes
        Outputs: (pulses, before + after) float32, and two of (pulses,) float64. NaN for a
        record that contains NaN.
    places
        Output, (pulses, 6) float64: where it was read. Sample before the half maximum about
        which baseline and level are, that of the normalised record, time of the half maximum
        after it, first sample of the tail, centre of the current amplitude and its phase.
    """
    tail = np.empty(w.fit_samples, np.float32)
    logs = np.empty(w.fit_samples, np.float32)
    current = np.empty(w.before + w.after - 1, np.float32)
    near = w.edge // 3  # of a crossing, or of the steepest sample, within which the maximum is
    for row in range(len(records)):
        record = records[row]
        _, sample = _crossing(record, w.level, w.last)
        _normalise(record, sample, w)
        time, again = _crossing(record, w.level, sample + near)
        if again != sample:
            # baseline and level are taken relative to the crossing of the normalised record:
            # with a decay of 50 us, one sample off is many standard deviations of a mean
            _normalise(record, again, w)
            time, half = _crossing(record, w.level, again + near)
        else:
            half = again
        if not math.isfinite(time):
            aligned[row], slopes[row], amplitudes[row] = math.nan, math.nan, math.nan
            places[row] = 0
            continue
        _window(record, time, w, aligned[row])
        start = half + (time - half >= 0.5) + w.tail  # from the nearest sample
        slopes[row] = _tail_slope(record, start, w, tail, logs)
        for i in range(len(current)):
            current[i] = aligned[row, i + 1] - aligned[row, i]
        steepest = max(w.before - w.edge, 0)
        for i in range(steepest, min(w.before + w.edge, len(current))):
            if current[i] > current[steepest]:
                steepest = i
        amplitudes[row], centre, phase = _amplitude(
            current, steepest - near, steepest + near + 1, weights
        )
        places[row, 0], places[row, 1], places[row, 2] = again, half, time - half
        places[row, 3], places[row, 4], places[row, 5] = start, centre, phase


@kernel(error_model="numpy")
def add_noise(
    records: Any, traces: Any, trace: Any, start: Any, factor: Any, noisy: Any
) -> None:  # pragma: no cover - compiled
    """Add part of a noise trace to each record: index of the trace, start sample, factor."""
    for row in range(len(records)):
        drawn, first, scale = traces[trace[row]], start[row], factor[row]
        for i in range(records.shape[1]):
            noisy[row, i] = records[row, i] + scale * drawn[first + i]


@kernel(error_model="numpy", fastmath=FAST)
def project(aligned: Any, matrix: Any, out: Any) -> None:  # pragma: no cover - compiled
    """Product of aligned pulses and a matrix (samples, columns), in a single thread."""
    columns = matrix.shape[1]
    for row in range(len(aligned)):
        for k in range(columns):
            out[row, k] = 0
        for i in range(aligned.shape[1]):
            value = aligned[row, i]
            for k in range(columns):
                out[row, k] += value * matrix[i, k]
