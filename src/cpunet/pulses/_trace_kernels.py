"""Compiled loops over the samples of one trace: extremes, lines, flat tops, tails.

All sums are float64.  Traces are read in place and never copied.
"""

from __future__ import annotations

import math
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


@compiled
def all_finite(trace):  # type: ignore[no-untyped-def]
    bad = False
    for value in trace:
        bad |= (value - value) != 0
    return not bad


@_compiled_finite
def lowest_of(trace):  # type: ignore[no-untyped-def]
    lowest = trace[0]
    for value in trace:
        lowest = min(lowest, value)
    return lowest


@_compiled_finite
def highest_of(trace):  # type: ignore[no-untyped-def]
    highest = trace[0]
    for value in trace:
        highest = max(highest, value)
    return highest


@_compiled_finite
def mean_of(trace):  # type: ignore[no-untyped-def]
    total = 0.0
    for value in trace:
        total += np.float64(value)
    return total / len(trace)


@compiled
def first_at(trace, level):  # type: ignore[no-untyped-def]
    sample = 0
    while trace[sample] != level:
        sample += 1
    return sample


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
def quietest_rms(baseline):  # type: ignore[no-untyped-def]
    """RMS about a straight line in the quietest part of the baseline."""
    size = len(baseline) // _PARTS
    quietest = math.inf
    for part in range(_PARTS):
        _, _, rms = line(baseline[part * size : (part + 1) * size])
        quietest = min(quietest, rms)
    return quietest


@compiled
def _equal_neighbours(trace):  # type: ignore[no-untyped-def]
    """Fraction of equal neighbouring samples, and the smallest step between unequal ones."""
    equal, step = 1, math.inf  # start at 1: a probability is never exactly zero
    for i in range(1, len(trace)):
        difference = abs(trace[i] - trace[i - 1])
        if difference == 0:
            equal += 1
        else:
            step = min(step, difference)
    return equal / len(trace), step


@compiled
def _longest_run(trace, top, first, shortest):  # type: ignore[no-untyped-def]
    """Length and end of the longest run of `top`, if one has at least `shortest` samples."""
    longest = end = 0
    for sample in range(first, len(trace), shortest):  # no such run fits in between
        if trace[sample] == top:
            start = stop = sample
            while start > first and trace[start - 1] == top:
                start -= 1
            while stop < len(trace) and trace[stop] == top:
                stop += 1
            if stop - start > longest:
                longest, end = stop - start, stop
    return longest, end


@compiled
def is_saturated(trace, quiet, top, top_sample, saturation_run):  # type: ignore[no-untyped-def]
    """Whether the top of a measured trace is flatter than noise and ADC steps can explain.

    The first `quiet` samples show how often noise makes two neighbours equal.  Where it
    mostly does (coarse steps, or no noise), the fall after the flat top decides: clipping
    cuts off far more than one step.
    """
    longest, end = _longest_run(trace, top, top_sample, saturation_run)
    if longest < saturation_run:
        return False
    if top == 65535 or top == 16383 or top == 4095:  # full scale of 16, 14 and 12 bits
        return True
    chance, _ = _equal_neighbours(trace[:quiet])
    if chance ** (longest - 1) < _FLAT_BY_CHANCE:
        return True
    _, step = _equal_neighbours(trace)
    fall = top - trace[min(end + longest, len(trace)) - 1]
    return chance > 0.5 and fall > _FLAT_BY_STEPS * step


@_compiled_finite
def _residual_squares(tail, logs, mean, slope):  # type: ignore[no-untyped-def]
    """Squared residuals of the logarithm, each in units of one over the value."""
    centre, squares = 0.5 * (len(tail) - 1), 0.0
    for i in range(len(tail)):
        squares += ((logs[i] - mean - slope * (i - centre)) * tail[i]) ** 2
    return squares


@compiled
def tail_fit(tail, rms, logs):  # type: ignore[no-untyped-def]
    """Slope per sample of the logarithm and reduced chi-square; NaN if a value is ≤ 0."""
    if lowest_of(tail) <= 0:
        return math.nan, math.nan
    for i in range(len(tail)):
        logs[i] = math.log(tail[i])
    mean, slope, _ = line(logs)
    if rms == 0:
        return slope, math.nan
    # The error of a logarithm is the relative error of the value.
    squares = _residual_squares(tail, logs, mean, slope)
    return slope, squares / (rms * rms * (len(tail) - 2))


@compiled
def tail_mean(trace, stop, tail_samples):  # type: ignore[no-untyped-def]
    """Mean of the `tail_samples` before `stop`; the last value replaces missing samples."""
    total = 0.0
    for i in range(stop - tail_samples, stop):
        total += np.float64(trace[min(i, len(trace) - 1)])
    return total / tail_samples
