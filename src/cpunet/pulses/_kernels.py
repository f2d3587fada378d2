"""Compiled loops of the preparation: one raw trace in, one window and its numbers out.

First loops over the samples of one trace: extremes, lines, flat tops, tails.  All sums are
float64.  Traces are read in place and never copied.
"""

from __future__ import annotations

import math
from collections import namedtuple
from enum import IntEnum
from typing import Any

import numpy as np

from cpunet.kernels import kernel

# An earlier pulse disturbs one part of a baseline; the quietest part gives the noise.
_PARTS = 4
# Probability below which equal samples at the maximum are not attributed to noise.
_FLAT_BY_CHANCE = 1e-6
# A smooth maximum that looks flat because of the ADC steps falls by about eight steps
# over the next stretch of equal length; a clipped one falls by far more.
_FLAT_BY_STEPS = 16.0

compiled: Any = kernel(error_model="numpy")
# Called on finite values only, so the compiler can vectorise the comparisons.
_compiled_finite: Any = kernel(error_model="numpy", fastmath={"nnan", "nsz", "reassoc"})


@_compiled_finite
def mean_of(trace):  # type: ignore[no-untyped-def]
    total = 0.0
    for value in trace:
        total += np.float64(value)
    return total / len(trace)


@compiled
def crossing(trace, top_sample, threshold):  # type: ignore[no-untyped-def]
    """The sample after the last one below `threshold` before the maximum."""
    sample = top_sample
    while sample >= 0 and trace[sample] >= threshold:
        sample -= 1
    return sample + 1


@_compiled_finite
def line(values):  # type: ignore[no-untyped-def]
    """Mean, slope per sample and RMS about a straight line of equally spaced values."""
    n = len(values)
    if n < 3:
        return mean_of(values) if n else 0.0, 0.0, 0.0
    mean, centre = mean_of(values), 0.5 * (n - 1)
    moment = squares = 0.0
    for i in range(n):
        deviation = values[i] - mean
        moment += (i - centre) * deviation
        squares += deviation * deviation
    slope = moment / (n * (n * n - 1.0) / 12.0)
    return mean, slope, math.sqrt(max(squares - slope * moment, 0.0) / (n - 2))


@compiled
def is_saturated(trace, quiet, top, top_sample, saturation_run):  # type: ignore[no-untyped-def]
    """Whether the top of a measured trace is flatter than noise and ADC steps can explain.

    The first `quiet` samples show how often noise makes two neighbours equal.  Where it
    mostly does (coarse steps, or no noise), the fall after the flat top decides: clipping
    cuts off far more than one step.
    """
    longest = run = end = 0  # length and end of the longest run of `top`
    for sample in range(top_sample, len(trace)):
        run = run + 1 if trace[sample] == top else 0
        if run > longest:
            longest, end = run, sample + 1
    if longest < saturation_run:
        return False
    if top == 65535 or top == 16383 or top == 4095:  # full scale of 16, 14 and 12 bits
        return True
    steps = np.abs(np.diff(trace))
    # one more than there are: a probability is never exactly zero
    chance = (1 + (steps[: quiet - 1] == 0).sum()) / quiet
    fall = top - trace[min(end + longest, len(trace)) - 1]
    clipped = chance > 0.5 and fall > _FLAT_BY_STEPS * steps[steps > 0].min()
    return clipped or chance ** (longest - 1) < _FLAT_BY_CHANCE


@_compiled_finite
def _residual_squares(tail, logs, mean, slope):  # type: ignore[no-untyped-def]
    """Squared residuals of the logarithm, each in units of one over the value."""
    centre, squares = 0.5 * (len(tail) - 1), 0.0
    for i in range(len(tail)):
        squares += ((logs[i] - mean - slope * (i - centre)) * tail[i]) ** 2
    return squares


@compiled
def tail_fit(tail, rms):  # type: ignore[no-untyped-def]
    """Slope per sample of the logarithm and reduced chi-square; NaN if a value is ≤ 0."""
    if tail.min() <= 0:
        return math.nan, math.nan
    logs = np.log(tail).astype(np.float64)
    mean, slope, _ = line(logs)
    if rms == 0:
        return slope, math.nan
    # The error of a logarithm is the relative error of the value.
    squares = _residual_squares(tail, logs, mean, slope)
    return slope, squares / (rms * rms * (len(tail) - 2))


class Rejection(IntEnum):
    """Reason why a pulse was rejected; values and labels are stored and never change.

    Examples
    --------
    >>> Rejection(4).label
    'window_outside_record'
    """

    ACCEPTED, NAN, CONSTANT, SATURATED = range(4)
    WINDOW_OUTSIDE_RECORD, NO_AMPLITUDE, TAIL_NOT_POSITIVE = range(4, 7)
    PULSE_AT_EDGE, NO_PLATEAU, SECOND_PULSE = range(7, 10)
    ENERGY_UNKNOWN, ENERGY_OUTSIDE_SELECTION, NOT_DRAWN, COPIES = range(16, 20)
    TAIL_SLOPE, CHI2, BASELINE, BASELINE_SLOPE = range(32, 36)

    @property
    def label(self) -> str:
        """Name used in counts and reports."""
        return self.name.lower()


# Numbers of a pulse; slopes are per sample.
NUMBERS = (
    "baseline",
    "scale",
    "align_sample",
    "baseline_rms",
    "baseline_slope",
    "tail_slope",
    "chi2",
)

# The alignment moves the window of the baseline, and this the level at which it is searched.
# Two rounds settle all but exact ties.
_ROUNDS = 4
# If the first sample is at most this many times the rise to the second, it is charge that moved
# within that sample: for a constant current, its mean in the first period is half the rise.
_MAX_FIRST = 2.0
# A pulse has begun where it exceeds a hundredth of its height and is clear of the noise.  The
# baseline ends a microsecond earlier, since far from the contact charge induces less than that.
_BEGUN_FRACTION, _BEGUN_RMS, BEGUN_MARGIN_NS = 0.01, 8.0, 960.0
# In a thousand samples, noise alone reaches a maximum of three to four RMS; so much above that
# is a pulse.
_MIN_TOP_RMS, _MIN_HEIGHT_RMS = 8.0, 5.0
# A tail that rises by so much, in heights and in RMS, is no plateau.
_MAX_RISE, _MAX_RISE_RMS = 0.1, 4.0
# Values that differ by float32 rounding, in units of the amplitude, count as equal; and a
# crossing as of a sample that is as near but for rounding.
_ROUNDING, _NEAREST = 2.0 * 2.0**-23, 0.501
# Noise is averaged over this time before a pulse is searched.
SMOOTHED_NS = 480.0
# The level of half the height depends on the alignment: between two samples, noise can leave
# no alignment that is the nearest to its own crossing.  A window that is normalised to rounding
# is therefore aligned already if its crossing is within this time.  From half of the height to
# 99.9 % a pulse takes longer: windows that are aligned there are aligned anew.
PREPARED_NS, _NORMALISED = 128.0, 1e-5


# The preparation settings in the form that the compiled loop accepts, in samples; `of_maximum`
# is where pulses are aligned, 0 for half of the height.
Settings = namedtuple(
    "Settings",
    "simulated samples_before samples_after of_maximum baseline_samples tail_samples "
    "tail_level decay_fit_samples max_padding_before max_padding_after saturation_run "
    "smoothed begun_margin prepared",
)


@compiled
def _baseline_stretch(length, start, s):  # type: ignore[no-untyped-def]
    """Samples of the record in the baseline part of a window; at least one."""
    first = min(max(start, 0), length - 1)
    return first, min(max(start + s.baseline_samples, first + 1), length)


@compiled
def _base_of_window(trace, start, stop, s):  # type: ignore[no-untyped-def]
    """Level of a window before its pulse.

    For a simulated pulse this is its lowest value, unless it already rises at the first sample.
    The value of that sample is then charge that moved within it and must not be subtracted as a
    baseline.
    """
    if not s.simulated:
        first, last = _baseline_stretch(len(trace), start, s)
        return mean_of(trace[first:last])
    lowest = np.float64(trace[max(start, 0) : min(stop, len(trace))].min())
    moved = start <= 0 and 0 < lowest == trace[0]
    return 0.0 if moved and lowest <= _MAX_FIRST * (np.float64(trace[1]) - lowest) else lowest


@compiled
def _aligned(trace, top, top_sample, s):  # type: ignore[no-untyped-def]
    """Align, compute the baseline of that window, and repeat until nothing moves."""
    length = len(trace)
    if s.simulated:
        base = _base_of_window(trace, 0, length, s)
    else:
        base = mean_of(trace[: min(s.baseline_samples, max(1, top_sample // 2), length)])
    align = -1
    for _ in range(_ROUNDS):
        # Without a preference for an aligned sample that rounding alone could move, a prepared
        # pulse in ten thousand would shift by a sample when prepared again.
        threshold = base + s.of_maximum * (top - base)
        slack, refined = _ROUNDING * (top - base), s.samples_before
        first = crossing(trace, top_sample, threshold - slack)
        last = crossing(trace, top_sample, min(threshold + slack, top))
        if not first <= refined <= last:
            refined = crossing(trace, top_sample, threshold)
        if refined == align:
            break
        align = refined
        start, stop = align - s.samples_before, min(align + s.samples_after, length)
        if top_sample >= stop:
            top = np.float64(trace[align:stop].max())
            top_sample = align + trace[align:stop].argmax()
        base = _base_of_window(trace, start, stop, s)
    return align, base, top


@compiled
def _smoothed(trace, half):  # type: ignore[no-untyped-def]
    """Means over the samples up to `half` away; fewer at the ends of the trace."""
    length, samples = len(trace), np.arange(len(trace))
    sums = np.append(np.zeros(1), np.cumsum(trace.astype(np.float64)))
    first, stop = np.maximum(samples - half, 0), np.minimum(samples + half + 1, length)
    return (sums[stop] - sums[first]) / (stop - first)


@compiled
def _half_crossing(trace, smooth, align, s):  # type: ignore[no-untyped-def]
    """When a pulse that is aligned at a sample passes half of its height.

    Time in samples, base, height, and rise of the tail.  The height is that of a straight line
    through the tail at the alignment: a decay takes nothing from it, and noise moves it little.
    The crossing is searched backward from the plateau; the averaged trace decides which of
    several crossings by noise is meant.
    """
    start, stop, n = align - s.samples_before, align + s.samples_after, s.decay_fit_samples
    base, last = _base_of_window(trace, start, stop, s), len(trace) - 1
    tail = trace[np.minimum(np.arange(stop - n, stop), last)].astype(np.float64)
    mean, slope, _ = line(tail)
    height = mean + slope * (align - (stop - 0.5 * (n + 1))) - base

    level = base + 0.5 * height
    near = min(crossing(smooth, min(stop - n, last), level) + s.smoothed, last)
    sample = crossing(trace, near, level) - 1
    if sample < 0:  # charge that moved within the first sample
        time = 0.0
    elif sample == last:
        time = last + 1.0
    else:
        low, high = np.float64(trace[sample]), np.float64(trace[sample + 1])
        time = sample + (level - low) / (high - low)
    return time, base, height, slope * n


@compiled
def _aligned_half(trace, smooth, s):  # type: ignore[no-untyped-def]
    """The sample nearest to the crossing of half the height, base, height and rise."""
    length = len(trace)
    if length == s.samples_before + s.samples_after:  # prepared already?
        align = s.samples_before
        time, base, height, rise = _half_crossing(trace, smooth, align, s)
        if s.simulated:
            scale = np.float64(trace.max())
        else:
            scale = mean_of(trace[length - s.tail_samples :]) / s.tail_level
        normalised = abs(base) < _NORMALISED and abs(scale - 1.0) < _NORMALISED
        near = max(s.prepared, _NEAREST) if normalised else _NEAREST
        if abs(time - align) < near:
            return align, base, height, rise
    top = smooth.max()
    top_sample = smooth.argmax()
    base = smooth.min()
    if not s.simulated:
        base = mean_of(trace[: min(s.baseline_samples, max(1, top_sample // 2), length)])
    align = crossing(smooth, top_sample, base + 0.5 * (top - base))
    nearest, best = math.inf, (align, base, 0.0, 0.0)
    for _ in range(_ROUNDS):
        time, base, height, rise = _half_crossing(trace, smooth, align, s)
        if abs(time - align) < nearest:
            nearest, best = abs(time - align), (align, base, height, rise)
        if nearest < _NEAREST:
            break
        align = math.floor(min(max(time, 0.0), length) + 0.5)
    return best


@compiled
def _quiet(trace, start, mean, align, top, s):  # type: ignore[no-untyped-def]
    """RMS in the quietest part of the baseline; slope and RMS of the record before the pulse.

    The baseline part of a window can contain the start of a slow pulse, whose slope would
    make the quality cuts remove long drift times: the last `baseline_samples` before the pulse
    begins have neither.  A pulse that begins in the first half of that part is not slow: it is
    a piled-up pulse, which is left in so that the cuts find it.
    """
    first, last = _baseline_stretch(len(trace), start, s)
    size = (last - first) // _PARTS
    quietest = math.inf if size else 0.0
    for part in range(first, first + _PARTS * size, max(size, 1)):
        quietest = min(quietest, line(trace[part : part + size])[2])
    level = mean + max(_BEGUN_FRACTION * (top - mean), _BEGUN_RMS * quietest)
    begun = crossing(trace, min(align, len(trace) - 1), level)
    stop = min(max(begun - s.begun_margin, start + s.baseline_samples // 2, 3), len(trace))
    _, slope, rms = line(trace[max(stop - s.baseline_samples, 0) : stop])
    return quietest, slope, rms


@compiled
def _prepare_one(trace, s, window, numbers):  # type: ignore[no-untyped-def]
    """Fill a window and its `NUMBERS` from a trace and return its code."""
    if not np.isfinite(trace).all():
        return Rejection.NAN
    length, top = len(trace), np.float64(trace.max())
    if top == trace.min():
        return Rejection.CONSTANT
    top_sample = trace.argmax()
    quiet = min(s.baseline_samples, max(2, top_sample // 2), length)
    if not s.simulated and is_saturated(trace, quiet, top, top_sample, s.saturation_run):
        return Rejection.SATURATED

    smooth = _smoothed(trace, s.smoothed)
    if s.of_maximum == 0:
        align, base, height, rise = _aligned_half(trace, smooth, s)
        top = np.float64(trace[: align + s.samples_after].max())
    else:
        align, base, top = _aligned(trace, top, top_sample, s)
        height, rise = top - base, 0.0
    start = align - s.samples_before
    stop = align + s.samples_after
    first, last = _baseline_stretch(length, start, s)
    mean, slope, rms = line(trace[first:last])
    if s.simulated:
        scale = top - base
    else:
        quietest, slope, rms = _quiet(trace, start, mean, align, top, s)
        if height < (_MIN_HEIGHT_RMS if s.of_maximum == 0 else _MIN_TOP_RMS) * quietest:
            return Rejection.NO_AMPLITUDE
        # no samples for the baseline, or more to fill in than is allowed
        before = min(s.max_padding_before, s.baseline_samples - 1)
        if start < -before or stop > length + s.max_padding_after:
            highest = trace.max()
            if highest - mean_of(trace[:quiet]) < _MAX_RISE * (highest - trace.min()):
                return Rejection.NO_AMPLITUDE  # the pulse goes down
            short = length + before + s.max_padding_after < len(window)
            return Rejection.WINDOW_OUTSIDE_RECORD if short else Rejection.PULSE_AT_EDGE
        base = mean
        tail = trace[np.minimum(np.arange(stop - s.tail_samples, stop), length - 1)]
        scale = (tail.astype(np.float64).mean() - base) / s.tail_level
        if rise > max(_MAX_RISE * height, _MAX_RISE_RMS * quietest):
            # most of it within the time over which noise is averaged?
            part, width = smooth[stop - s.decay_fit_samples : stop], 2 * s.smoothed + 1
            jumps = (part[width:] - part[:-width] > 0.5 * rise).any()
            return Rejection.SECOND_PULSE if jumps else Rejection.NO_PLATEAU
    if not scale > 0:
        return Rejection.NO_AMPLITUDE

    # 0 before the record, its last value after it
    samples = np.minimum(np.maximum(np.arange(start, stop), 0), length - 1)
    window[:] = (trace[samples] - base) * (1.0 / scale)
    window[: max(0, -start)] = 0
    noise = rms / scale
    tail_slope, chi2 = tail_fit(window[-s.decay_fit_samples :], noise)
    if math.isnan(tail_slope):
        return Rejection.TAIL_NOT_POSITIVE
    numbers[:] = np.array([base, scale, align, noise, slope / scale, tail_slope, chi2])
    return Rejection.ACCEPTED


@compiled
def prepare_block(waveforms, s, windows, numbers, codes):  # type: ignore[no-untyped-def]
    """Prepare all traces; accepted ones fill the first rows.  Return their number."""
    n = 0
    for i in range(len(waveforms)):
        codes[i] = _prepare_one(waveforms[i], s, windows[n], numbers[n])
        n += codes[i] == Rejection.ACCEPTED
    return n
