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
# Gauss-Newton steps; three to five suffice unless the fit is degenerate.
_STEPS = 30
_SETTLED = 1e-9  # of the slow decay over the length of the fit
# Nearly equal slow and fast decays cannot be distinguished.
_SLOWEST_FAST = 0.5
_DEGENERATE = 1e-9  # determinant over the product of the diagonal

_compiled: Any = kernel(error_model="numpy")
# For sums over finite values, which the compiler can then reorder and vectorise.
_compiled_sum: Any = kernel(
    error_model="numpy", fastmath={"nnan", "nsz", "reassoc", "contract"}
)


@_compiled
def _last_rise(pulse, top, threshold):  # type: ignore[no-untyped-def]
    """Time at which the pulse last rises through `threshold` before the sample `top`."""
    if not pulse[top] >= threshold:
        return math.nan
    sample = top
    while sample > 0 and pulse[sample - 1] >= threshold:
        sample -= 1
    if sample == 0:
        return math.nan
    below = pulse[sample - 1]
    return sample - 1 + (threshold - below) / (pulse[sample] - below)


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


@_compiled
def _correct(pulse, rate, corrected):  # type: ignore[no-untyped-def]
    """Undo a decay with `rate` per sample, as dspeed's ``pole_zero`` does."""
    kept = math.exp(-rate)
    value = np.float64(pulse[0])
    corrected[0] = value
    for i in range(1, len(pulse)):
        value += pulse[i] - kept * pulse[i - 1]
        corrected[i] = value


@_compiled
def _corrected_shape(pulse, rate, plateau, fraction, corrected):  # type: ignore[no-untyped-def]
    """Overshoot and late charge (in samples) of one pulse without its decay."""
    _correct(pulse, rate, corrected)
    begin = len(pulse) - plateau
    height = corrected[begin:].mean()
    if begin < 1 or not height > 0:
        return math.nan, math.nan
    top = corrected[:begin].argmax()
    late = math.nan
    start = _last_rise(corrected, top, fraction * height)
    if start >= 0:
        late = _missing(corrected, start, len(pulse) - 1, height)
    return corrected[top] / height - 1, late


@_compiled
def _corrected_shapes(waveforms, rates, plateau, fraction, overshoots, late):  # type: ignore[no-untyped-def]
    corrected = np.empty(waveforms.shape[1])
    for i in range(len(waveforms)):
        overshoots[i] = late[i] = math.nan
        if math.isfinite(rates[i]):
            overshoots[i], late[i] = _corrected_shape(
                waveforms[i], rates[i], plateau, fraction, corrected
            )


@_compiled_sum
def _normal_equations(tail, fast, slow, rate, height, share):  # type: ignore[no-untyped-def]
    """Sums for the normal equations: products of derivatives and residuals.

    The derivatives are those with respect to the slow height, its rate and the fast height.
    """
    centre, kept = 0.5 * (len(tail) - 1), math.exp(-rate)
    value = math.exp(rate * centre)
    aa = ab = ac = bb = bc = cc = ar = br = cr = rr = 0.0
    for i in range(len(tail)):
        slow[i] = value
        value *= kept
    for i in range(len(tail)):
        by_rate = -height * (i - centre) * slow[i]
        residual = tail[i] - height * slow[i] - share * fast[i]
        aa += slow[i] * slow[i]
        ab += slow[i] * by_rate
        ac += slow[i] * fast[i]
        bb += by_rate * by_rate
        bc += by_rate * fast[i]
        cc += fast[i] * fast[i]
        ar += slow[i] * residual
        br += by_rate * residual
        cr += fast[i] * residual
        rr += residual * residual
    return aa, ab, ac, bb, bc, cc, ar, br, cr, rr


@_compiled
def _two_decays(tail, fast, slow, rate, fast_rate):  # type: ignore[no-untyped-def]
    """Rate and height of the slow decay, height of the fast one and residual RMS.

    Heights refer to the middle of the tail; `rate` is the starting value.
    """
    n, height, share = len(tail), np.float64(tail.mean()), 0.0
    for _ in range(_STEPS):
        aa, ab, ac, bb, bc, cc, ar, br, cr, _ = _normal_equations(
            tail, fast, slow, rate, height, share
        )
        # the 3x3 system by cofactors
        AA, AB, AC = bb * cc - bc * bc, ac * bc - ab * cc, ab * bc - ac * bb
        determinant = aa * AA + ab * AB + ac * AC
        if not determinant > _DEGENERATE * aa * bb * cc:
            break
        BB, BC, CC = aa * cc - ac * ac, ab * ac - aa * bc, aa * bb - ab * ab
        change = (AB * ar + BB * br + BC * cr) / determinant
        height += (AA * ar + AB * br + AC * cr) / determinant
        share += (AC * ar + BC * br + CC * cr) / determinant
        rate += change
        if not abs(rate) < _SLOWEST_FAST * fast_rate:
            break
        if abs(change) * n < _SETTLED:
            squares = _normal_equations(tail, fast, slow, rate, height, share)[-1]
            return rate, height, share, math.sqrt(squares / (n - 3))
    return math.nan, math.nan, math.nan, math.nan


@_compiled
def _two_decay_fits(tails, rates, fast_rate, offset, results):  # type: ignore[no-untyped-def]
    n = tails.shape[1]
    slow = np.empty(n)
    middle = 0.5 * (n - 1)
    fast = np.exp(-fast_rate * (np.arange(n) - middle))
    for i in range(len(tails)):
        results[i] = math.nan
        if n > 3 and math.isfinite(rates[i]):
            rate, height, share, rms = _two_decays(tails[i], fast, slow, rates[i], fast_rate)
            # extrapolate from the middle of the tail back to the aligned sample
            height *= math.exp(rate * (offset + middle))
            share *= math.exp(fast_rate * (offset + middle))
            results[i, 0], results[i, 1], results[i, 2] = rate, share / (height + share), rms


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


def corrected_shapes(
    waveforms: FloatArray, rates: Values, plateau: int, fraction: float
) -> tuple[Values, Values]:
    r"""Overshoot (a fraction) and late charge (in samples) after pole-zero correction.

    .. math:: \frac{\max_t x(t)}{P} - 1, \qquad \frac{1}{P} \int_{t_f} [P - x(t)] \, dt

    of the corrected pulse :math:`x` with the plateau :math:`P`, the mean of the last `plateau`
    samples.  The maximum is taken before the plateau, and charge that arrives after
    :math:`x(t_f) = f P` is late.  Pulses ``(n, length)`` decay with `rates` per sample (NaN for
    no value).
    """
    overshoots, late = np.empty(len(waveforms)), np.empty(len(waveforms))
    _corrected_shapes(waveforms, rates, plateau, fraction, overshoots, late)
    return overshoots, late


def two_decay_fits(
    tails: FloatArray, rates: Values, fast_rate: float, offset: float
) -> tuple[Values, Values, Values]:
    """Least-squares fit of a decay of free rate and one of known rate to each tail.

    Tails have shape ``(n, samples)``.  The search for the slow rate starts at `rates` per
    sample (NaN for no value).  The share of the fast decay is evaluated `offset` samples
    before the tail.  Returns the slow rate per sample, the share of the fast decay in the
    sum of both, and the residual RMS.
    """
    results = np.empty((len(tails), 3))
    _two_decay_fits(tails, rates, fast_rate, offset, results)
    return results[:, 0], results[:, 1], results[:, 2]


def current_widths(waveforms: FloatArray, weights: FloatArray) -> Values:
    """Full width at half maximum of the smoothed current of ``(n, length)``, in samples.

    The weights are those of `cpunet.pulses.parameters.current_amplitude_kernel`.
    """
    widths = np.empty(len(waveforms))
    # negative weights are rounding errors that would make the current of a falling pulse > 0
    _current_widths(waveforms, np.clip(weights.astype(float), 0, None), widths)
    return widths
