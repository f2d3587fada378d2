"""Pulse-shape parameters of prepared pulses, and alignment at half of their maximum.

Current amplitude, drift time and tail slope are the three parameters by which the paper
evaluates a translation (section 4.3).  The first two are those of dspeed's processors, so they
equal the values of the experiments' production analysis.

Where pulses cross half of their maximum, and what they are when shifted by parts of a sample,
is given by the cubic spline through the samples: linear interpolation would smooth the edge.

The current amplitude is a product of matrices in float32; all other sums are float64.  An
undefined value is NaN and never raises an exception.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses, blocks, line_slope, shortest
from cpunet.recipes.schema import PreparationConfig, ScoreConfig

Values = npt.NDArray[np.float64]


class Parameter(NamedTuple):
    """Label and unit of a parameter for an axis."""

    label: str
    unit: str

    @property
    def axis_label(self) -> str:
        """Label and unit as one string, ``"Tail slope [1/ms]"``."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


PARAMETERS = {
    "current_amplitude": Parameter("Current amplitude", "1/sample"),
    "drift_time": Parameter("Drift time, 1 % to maximum", "ns"),
    "tail_slope": Parameter("Tail slope", "1/ms"),
}

# I_max as defined by Majorana and LEGEND at 16 ns: moving averages in steps of 1 ns.
AVERAGE_NS, AVERAGES, REFERENCE_NS = 48.0, 3, 16.0
# Part of the difference of two periods squared that a further average makes up for, see
# `current_amplitude`.
SHORTER = 2.5
# Time around the steepest point of a pulse that is searched first for the maximum.
NEIGHBOURHOOD_NS = 768.0

BLOCK = 256  # pulses per block: bounds memory and keeps the buffers in the cache


def current_amplitude(waveforms: FloatArray, dt_ns: float) -> Values:
    r"""Maximum current of each pulse (A of A/E; the paper's I_max, section 4.3.2).

    .. math:: I_{\max} = \max_t \, (h * h * h * i)(t), \qquad i_k = x_{k+1} - x_k

    with the moving average :math:`h` over 48 ns in steps of 1 ns, as defined by Majorana
    (arXiv:1901.05388).  At 16 ns it is the result of dspeed's processors
    ``avg_current(1)`` → ``upsampler(16)`` → ``moving_window_multi(48, 3, 0)`` → ``min_max``,
    to single precision, but without averages that reach beyond the ends of a pulse.

    At 16 ns, the difference over a sample and holding it for a sample average the current, too,
    as does the digitiser where samples are means.  At a shorter period :math:`\Delta t` a
    further moving average over :math:`\sqrt{2.5\,(16^2 - \Delta t^2)}` ns has nearly the
    variance that they lack: of two such averages for samples at a time, of three for means.
    Divided by the period, the amplitude of an edge is then the same within half a percent.

    Each averaged value is a positively weighted mean of the current some samples away, see
    `current_amplitude_kernel`.  Therefore only the part around the steepest point of a pulse is
    averaged first.  If the current elsewhere exceeds the maximum of that part, the whole pulse
    is.

    Parameters
    ----------
    waveforms
        Pulses of shape ``(n, length)``.
    dt_ns
        Sampling period in ns.

    Returns
    -------
    numpy.ndarray
        Float64, shape ``(n,)``, in pulse heights per sample; divide by the period to compare
        periods.  NaN for a pulse with a NaN.

    Raises
    ------
    CpunetError
        If the pulses are shorter than the moving averages.

    Examples
    --------
    A straight rise over 200 samples has a current of 1/200:

    >>> import numpy as np
    >>> ramp = np.clip(np.arange(-100.0, 300.0) / 200.0, 0, 1).astype(np.float32)
    >>> current_amplitude(ramp[np.newaxis], dt_ns=16).round(6)
    array([0.005])
    """
    weights = current_amplitude_kernel(dt_ns)
    reach = weights.shape[1] // 2
    near = max(round(NEIGHBOURHOOD_NS / dt_ns), 7 * reach)

    def highest(current: FloatArray) -> FloatArray:
        around = np.lib.stride_tricks.sliding_window_view(current, 2 * reach + 1, axis=1)
        means = around.reshape(-1, 2 * reach + 1) @ weights.T
        return np.asarray(means.reshape(len(current), -1).max(axis=1))

    require_pulses(waveforms, 2 * reach + 2)
    amplitudes = np.empty(len(waveforms))
    # samples and averages near the steepest point are as many more as the period is shorter
    for rows in blocks(len(waveforms), max(1, round(BLOCK * min(1.0, dt_ns / REFERENCE_NS)))):
        current = np.diff(np.ascontiguousarray(waveforms[rows], np.float32), axis=1)
        samples = current.shape[1]
        n = min(near, samples)
        first = np.clip(current.argmax(axis=1) - n // 2, 0, samples - n)[:, np.newaxis]
        part = np.take_along_axis(current, first + np.arange(n), axis=1)
        values = highest(part).astype(float)
        # other averages are less than the current that these do not reach, or in part
        elsewhere = current.copy()
        np.put_along_axis(elsewhere, first + np.arange(2 * reach, n - 2 * reach), -np.inf, 1)
        if len(unsure := np.flatnonzero(~(elsewhere.max(axis=1) <= values))):
            values[unsure] = highest(current[unsure])
        amplitudes[rows] = values
    return amplitudes


def shorth(values: Values) -> float:
    """Median of the shortest half of the values.

    For current amplitudes this is the single-site peak, which is the narrowest.

    Examples
    --------
    >>> shorth(np.array([0.0, 1.0, 5.0, 5.1, 5.2, 9.0]))
    5.1
    """
    ordered = np.sort(values[np.isfinite(values)])
    return float(np.median(shortest(ordered, len(ordered) // 2 + 1)[:-1]))


def current_amplitude_kernel(dt_ns: float) -> npt.NDArray[np.float32]:
    """Weights of the current's samples on the fine grid of the current amplitude.

    Returns
    -------
    numpy.ndarray
        Float32, shape ``(steps, 2 * reach + 1)``: for each step within a sample, the weights of
        the current from `reach` samples before to as many after it.
    """
    steps = max(1, round(dt_ns))
    further = math.sqrt(SHORTER * max(REFERENCE_NS**2 - dt_ns**2, 0.0))
    times = [AVERAGE_NS] * AVERAGES + [further] * (further > 0)
    widths = [max(1, round(time * steps / dt_ns)) for time in times]
    reach = math.ceil(sum(widths[::2]) / steps + 1.5)
    # a current of one sample, centred on its steps; averages over times before, after, ...
    response, first = np.ones(steps), reach * steps - steps // 2
    for number, width in enumerate(widths):
        response = np.convolve(response, np.full(width, 1 / width))
        first -= (width - 1) * (number % 2)
    fine = np.zeros((2 * reach + 1) * steps, np.float32)
    fine[first : first + len(response)] = response
    # the response at sample j to a unit current at sample 0 is the weight of the current j
    # samples earlier
    return np.ascontiguousarray(fine.reshape(-1, steps)[::-1].T)


def drift_time(waveforms: FloatArray, dt_ns: float, start_fraction: float) -> Values:
    r"""Time from a small fraction of the maximum to the maximum (paper, section 4.3.1).

    .. math:: T_{\mathrm{drift}} = t_{100} - t_f, \qquad x(t_f) = f \, x_{\max}

    with :math:`f` the `start_fraction`.  The interval ends at the first sample that holds
    the maximum.  The pulse is searched backward from there for its crossing of
    :math:`f x_{\max}`, whose time is interpolated linearly between two samples; whole
    samples would put steps of `dt_ns` into the distribution.

    On a long flat top, noise decides where the maximum is.  This is the paper's definition;
    it is not the time until the charge is collected.

    Parameters
    ----------
    waveforms
        Pulses of shape ``(n, length)`` with the baseline at 0.
    dt_ns
        Sampling period in ns.
    start_fraction
        Fraction of the maximum at which the interval begins (0.01 in the paper).

    Returns
    -------
    numpy.ndarray
        Float64, shape ``(n,)``, in ns; NaN where there is no such crossing.

    Raises
    ------
    CpunetError
        If the pulses have fewer than two samples.

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.clip(np.arange(-100.0, 300.0) / 200.0, 0, 1).astype(np.float32)
    >>> drift_time(ramp[np.newaxis], dt_ns=16, start_fraction=0.01).round(3)
    array([3168.])
    """
    require_pulses(waveforms, 2)
    times = np.empty(len(waveforms))
    for rows in blocks(len(waveforms), BLOCK):
        block = np.asarray(waveforms[rows], np.float32)
        # the fraction in single precision, as of the pulse
        end, levels = block.argmax(axis=1), start_fraction * block.max(axis=1)
        start = crossings(block.astype(float), levels.astype(float), end)
        times[rows] = (end - start) * dt_ns
    return times


def tail_slope(waveforms: FloatArray, dt_ns: float, fit_samples: int) -> Values:
    r"""Slope of the logarithm of the tail, by an unweighted straight-line fit.

    .. math:: c_{\mathrm{tail}} = \frac{\sum_k (t_k - \bar{t}) \ln x_k}
        {\sum_k (t_k - \bar{t})^2} = -\frac{1}{\tau}

    where the last equality is for an exponential decay with time constant :math:`\tau`.
    The paper (section 4.3.3) fits the logarithm of 300 samples.  The slope is negative for
    a decay and 0 for a simulation without electronics.

    Parameters
    ----------
    waveforms
        Pulses of shape ``(n, length)`` with the baseline at 0.
    dt_ns
        Sampling period in ns.
    fit_samples
        Number of samples at the end of the pulse that are fitted.

    Returns
    -------
    numpy.ndarray
        Float64, shape ``(n,)``, in 1/ms; NaN for a tail with a value of 0 or less.

    Raises
    ------
    CpunetError
        If the pulses are shorter than `fit_samples`.

    Examples
    --------
    >>> import numpy as np
    >>> decay = np.exp(-np.arange(800) * 16 / 54_600)[np.newaxis].astype(np.float32)
    >>> (-1e3 / tail_slope(decay, dt_ns=16, fit_samples=300)).round(2)  # in µs
    array([54.6])
    """
    require_pulses(waveforms, fit_samples)
    weights, slopes = line_slope(fit_samples) / (dt_ns * 1e-6), np.full(len(waveforms), np.nan)
    for rows in blocks(len(waveforms), BLOCK):
        tail = np.asarray(waveforms[rows, -fit_samples:], np.float32).astype(float)
        usable = (np.isfinite(tail) & (tail > 0)).all(axis=1)
        slopes[rows][usable] = np.log(tail[usable]) @ weights
    return slopes


def pulse_parameters(
    pulses: Pulses, preparation: PreparationConfig, scores: ScoreConfig
) -> dict[str, Values]:
    """All parameters of `PARAMETERS`, each an array with one value per pulse.

    Parameters
    ----------
    pulses
        Prepared pulses.
    preparation
        Preparation settings, with the number of tail samples that are fitted.
    scores
        Score settings, with the fraction of the maximum at which the drift time begins.

    Returns
    -------
    dict
        ``current_amplitude`` in pulse heights per sample, ``drift_time`` in ns and
        ``tail_slope`` in 1/ms.
    """
    waveforms, dt_ns = pulses.waveforms, pulses.dt_ns
    return {
        "current_amplitude": current_amplitude(waveforms, dt_ns),
        "drift_time": drift_time(waveforms, dt_ns, scores.drift_start_fraction),
        "tail_slope": tail_slope(waveforms, dt_ns, preparation.at(dt_ns).decay_fit_samples),
    }


BISECTIONS = 30  # of one sample: a precision of 1e-9
PAD = 8  # samples of the edge value; the effect of the spline's end falls 3.7-fold per sample


def _spline(near: Sequence[Values], t: Values) -> Values:
    """Cubic spline of coefficients at -1, 0, 1 and 2, at times between 0 and 1."""
    s = 1 - t
    weights = s * s * s, 3 * t * t * t - 6 * t * t + 4, 3 * s * s * s - 6 * s * s + 4, t * t * t
    a, b, c, d = (w / 6 * values for w, values in zip(weights, near, strict=True))
    return np.asarray(a + b + c + d)


def crossings(waveforms: Values, levels: Values, stops: npt.NDArray[np.int64]) -> Values:
    """Times in samples of the last crossings of levels before a sample; NaN without any.

    They are those of dspeed's ``interpolated_time_point_thresh``, backward and with straight
    lines between samples, of waveforms ``(..., length)``, a level and a sample for each.
    """
    from dspeed.processors.time_point_thresh import interpolated_time_point_thresh  # a second

    return np.asarray(interpolated_time_point_thresh(waveforms, levels, stops, 0, ord("l")))


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
    require_pulses(waveforms, 2)
    aligned = np.empty((len(waveforms), n_before + n_after), np.float32)
    for rows in blocks(len(waveforms)):
        aligned[rows] = aligned_block(waveforms[rows], n_before, n_after)
    return aligned


def require_pulses(waveforms: FloatArray, shortest: int) -> None:
    """Raise a `CpunetError` unless an array has the shape (pulses, samples)."""
    if waveforms.ndim != 2 or waveforms.shape[1] < shortest:
        expected = f"expected (pulses, samples) with {shortest} samples or more"
        raise CpunetError(f"waveforms have shape {waveforms.shape}; {expected}")


def aligned_block(waveforms: FloatArray, n_before: int, n_after: int) -> Values:
    """One block of `align_half_maximum`, in float64."""
    from scipy.ndimage import spline_filter1d

    moved = np.full((len(waveforms), n_before + n_after), np.nan)
    finite = np.isfinite(waveforms).all(axis=1)
    top = np.where(finite, waveforms.argmax(axis=1), 0)
    height = waveforms[np.arange(len(waveforms)), top]
    # the last sample before the maximum that is below its half
    below = waveforms < 0.5 * height[:, np.newaxis]
    below &= np.arange(waveforms.shape[1]) < top[:, np.newaxis]
    last = waveforms.shape[1] - 1 - below[:, ::-1].argmax(axis=1)
    if not (usable := finite & (height > 0) & below.any(axis=1)).any():
        return moved
    pulses, before = waveforms[usable], last[usable]
    padded = np.pad(pulses.astype(float), ((0, 0), (PAD, PAD)), mode="edge")
    coefficients = spline_filter1d(padded, order=3, axis=1)
    level = 0.5 * pulses.max(axis=1).astype(float)
    rows, places = np.arange(len(pulses)), before + PAD + np.arange(-1, 3)[:, np.newaxis]
    near, low, high = coefficients[rows, places], np.zeros(len(pulses)), np.ones(len(pulses))
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        below = _spline(near, middle) < level
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    times = before + 0.5 * (low + high)
    n, start = n_before + n_after, np.floor(times).astype(int)
    samples = start[:, np.newaxis] - n_before + np.arange(-1, n + 2)
    places = (samples + PAD).clip(0, padded.shape[1] - 1)
    around = np.take_along_axis(coefficients, places, axis=1)
    part = (times - start)[:, np.newaxis]
    shifted = _spline([around[:, k : k + n] for k in range(4)], part)
    end = pulses.shape[1] - (times > start)
    shifted[(samples[:, 1:-2] < 0) | (samples[:, 1:-2] >= end[:, np.newaxis])] = np.nan
    moved[usable] = shifted
    return moved
