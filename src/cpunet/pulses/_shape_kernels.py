"""Compiled loops of the shape parameters: one pulse in, its numbers out.

All sums are float64.  An undefined value is NaN and never raises an exception.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel
from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]

# Half a sample from its maximum, the smoothed current is still within 6 % of it: the
# averages alone smear it with a sigma of 1.5 samples.
_NEAR_MAXIMUM = 0.8

_compiled: Any = kernel(error_model="numpy")
# For sums over finite values, which the compiler can then reorder and vectorise.
_compiled_sum: Any = kernel(
    error_model="numpy", fastmath={"nnan", "nsz", "reassoc", "contract"}
)


@_compiled
def _missing(pulse, start, stop, height):  # type: ignore[no-untyped-def]
    """Area between `height` and the pulse from time `start` to sample `stop`, over `height`."""
    first = math.ceil(start)
    if first >= stop:
        return math.nan
    # straight lines between samples, with a partial interval at the start
    share = first - start
    area = 0.0
    if share > 0:
        at_start = pulse[first] + share * (pulse[first - 1] - pulse[first])
        area = share * (height - 0.5 * (at_start + pulse[first]))
    for i in range(first, stop):
        area += height - 0.5 * (pulse[i] + pulse[i + 1])
    return area / height


@_compiled
def _missing_areas(waveforms, starts, stops, areas):  # type: ignore[no-untyped-def]
    for i in range(len(waveforms)):
        areas[i] = math.nan
        if starts[i] >= 0 and stops[i] > starts[i]:
            stop = int(stops[i])
            areas[i] = _missing(waveforms[i], starts[i], stop, np.float64(waveforms[i, stop]))


@_compiled_sum
def _smoothed(current, weights, step):  # type: ignore[no-untyped-def]
    """The smoothed current at a step of the fine grid."""
    steps, taps = weights.shape
    first, phase = step // steps - taps // 2, step % steps
    total = 0.0
    for i in range(taps):
        total += weights[phase, i] * current[first + i]
    return total


@_compiled
def _current_maximum(current, weights, samples):  # type: ignore[no-untyped-def]
    """Step and value of the smoothed current's maximum; `samples` is a buffer."""
    steps, reach = len(weights), weights.shape[1] // 2
    stop = len(current) - reach
    rough = -math.inf
    for i in range(reach, stop):
        samples[i] = _smoothed(current, weights, i * steps)
        rough = max(rough, samples[i])
    best, highest = -1, 0.0
    if not rough > 0:
        return best, highest
    for i in range(reach, stop):
        if max(samples[i], samples[min(i + 1, stop - 1)]) >= _NEAR_MAXIMUM * rough:
            for step in range(i * steps, (i + 1) * steps):
                value = _smoothed(current, weights, step)
                if value > highest:
                    best, highest = step, value
    return best, highest


@_compiled
def _half_width(current, weights, top, highest, direction):  # type: ignore[no-untyped-def]
    """Steps from the maximum to half of it, on the left (-1) or right (+1)."""
    steps, reach = len(weights), weights.shape[1] // 2
    first, last = reach * steps, (len(current) - reach) * steps - 1
    step, before = top, highest
    while first <= step + direction <= last:
        step += direction
        value = _smoothed(current, weights, step)
        if value <= 0.5 * highest:
            return abs(step - top) - 1 + (before - 0.5 * highest) / (before - value)
        before = value
    return math.nan


@_compiled
def _current_widths(waveforms, weights, widths):  # type: ignore[no-untyped-def]
    current, samples = np.empty(waveforms.shape[1] - 1), np.empty(waveforms.shape[1] - 1)
    for i in range(len(waveforms)):
        widths[i] = math.nan
        for j in range(len(current)):
            current[j] = waveforms[i, j + 1] - waveforms[i, j]
        if math.isfinite(current.sum()):  # a current with a NaN has no maximum
            top, highest = _current_maximum(current, weights, samples)
            if top >= 0:
                left = _half_width(current, weights, top, highest, -1)
                right = _half_width(current, weights, top, highest, 1)
                widths[i] = (left + right) / len(weights)


def missing_areas(waveforms: FloatArray, starts: Values, stops: Values) -> Values:
    r"""Area between a step and each pulse ``(n, length)``, divided by its height, in samples.

    .. math:: \frac{1}{x(t_1)} \int_{t_0}^{t_1} [x(t_1) - x(t)] \, dt

    from the time :math:`t_0` in `starts` (NaN for no value) to the sample :math:`t_1` in
    `stops`, with straight lines between samples.
    """
    areas = np.empty(len(waveforms))
    _missing_areas(waveforms, np.ascontiguousarray(starts), stops, areas)
    return areas


def current_widths(waveforms: FloatArray, weights: FloatArray) -> Values:
    """Full width at half maximum of the smoothed current of ``(n, length)``, in samples.

    The weights are those of `cpunet.pulses.parameters.current_amplitude_kernel`.
    """
    widths = np.empty(len(waveforms))
    # negative weights are rounding errors that would make the current of a falling pulse > 0
    _current_widths(waveforms, np.clip(weights.astype(float), 0, None), widths)
    return widths
