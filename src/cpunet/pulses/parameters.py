"""Pulse-shape parameters of prepared pulses: current amplitude, drift time, tail slope.

The three parameters by which the paper judges a translation (section 4.3).  Current
amplitude and drift time come from dspeed's processors, so that they are the numbers
which the production analysis of the experiments would give.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.recipes.schema import PreparationConfig, ScoreConfig

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """How a parameter is written on an axis: its label and its unit."""

    label: str
    unit: str

    @property
    def axis_label(self) -> str:
        """Label and unit as one string, ``"Tail slope [1/ms]"``."""
        return f"{self.label} [{self.unit}]"


PARAMETERS = {
    "current_amplitude": Parameter("Current amplitude $I_{max}$", "1/sample"),
    "drift_time": Parameter("Drift time, 1 % to maximum", "ns"),
    "tail_slope": Parameter("Tail slope", "1/ms"),
}

# The definition of I_max used by Majorana and LEGEND: 16 steps per sample (1 ns for
# 16-ns records) and three moving averages over 48 of them.
UPSAMPLING = 16
AVERAGE_STEPS = 48
AVERAGES = 3

# Samples beyond which the averages see nothing: they look 94 steps back and 47 ahead.
REACH = 8
# Samples around the steepest point in which the maximum is sought first.
NEIGHBOURHOOD = 96

BLOCK = 256  # pulses at a time: bounds memory, and the buffers stay in the cache


def current_amplitude(waveforms: FloatArray) -> Values:
    """Maximum current of each pulse (A of A/E; the paper's I_max, section 4.3.2).

    The maximum of ``avg_current(1)`` → ``upsampler(16)`` →
    ``moving_window_multi(48, 3, 0)`` → ``min_max``, all of them dspeed's processors.

    Each value of that chain is a mean, with positive weights, of the current's
    values at most `REACH` samples away.  So the chain needs to be run only around
    the steepest point of a pulse wherever no value of the current elsewhere exceeds
    the maximum found there; pulses that fail this test go through it in full.

    Parameters
    ----------
    waveforms
        Pulses of shape ``(n, length)``.

    Returns
    -------
    numpy.ndarray
        Float64, shape ``(n,)``, in pulse heights per sample; NaN for a pulse with a NaN.

    Raises
    ------
    CpunetError
        If the pulses are shorter than the moving averages.
    """
    shortest = AVERAGE_STEPS // UPSAMPLING + 3
    return _by_blocks(_current_amplitude, waveforms, shortest)


def current_amplitude_kernel() -> npt.NDArray[np.float32]:
    """Weights with which the current's samples enter the amplitude's fine grid.

    Returns
    -------
    numpy.ndarray
        Float32, shape ``(16, 2 * REACH + 1)``: for each step of a sample, the weights of the
        current from `REACH` samples before to `REACH` after.
    """
    current = np.zeros((1, 4 * REACH + 2), np.float32)
    current[0, 2 * REACH] = 1
    grid = _averaged(current)[0].reshape(-1, UPSAMPLING)
    around = grid[REACH : 3 * REACH + 1]
    # a unit of current at 0 reaches sample j with the weight that j gives to sample -j
    return np.ascontiguousarray(around[::-1].T)


def drift_time(waveforms: FloatArray, dt_ns: float, start_fraction: float) -> Values:
    """Time from a small fraction of the maximum to the maximum (paper, section 4.3.1).

    The first sample that holds the maximum ends the interval.  From there the pulse
    is searched backward for its crossing of `start_fraction` times the maximum, whose
    time is interpolated linearly between two samples; a whole number of samples would
    put steps of `dt_ns` into the distribution.

    Where a pulse has a long flat top the maximum is wherever noise puts it: this is the
    paper's number, and no time after which the charge is collected.

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

    def one_block(block: FloatArray) -> Values:
        from dspeed.processors import interpolated_time_point_thresh, min_max

        _, end, _, height = min_max(block)
        # dspeed ignores a NaN start only after casting it to an integer
        known = np.isfinite(end)
        start = interpolated_time_point_thresh(
            block, start_fraction * height, np.where(known, end, 0).astype(int), 0, ord("l")
        )
        return np.where(known, (end.astype(float) - start) * dt_ns, np.nan)

    return _by_blocks(one_block, waveforms, shortest=2)


def tail_slope(waveforms: FloatArray, dt_ns: float, fit_samples: int) -> Values:
    """Slope of the logarithm of the tail, by an unweighted straight-line fit.

    The paper (section 4.3.3) fits the logarithm of 300 samples.  The slope is
    negative for a decay and 0 for a simulation without electronics.

    Parameters
    ----------
    waveforms
        Pulses of shape ``(n, length)`` with the baseline at 0.
    dt_ns
        Sampling period in ns.
    fit_samples
        The number of samples, counted from the end of the pulse, that are fitted.

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
    >>> decay_constant_us(tail_slope(decay, dt_ns=16, fit_samples=300)).round(2)
    array([54.6])
    """
    lever = np.arange(fit_samples) - (fit_samples - 1) / 2
    weights = lever / (lever @ lever) / (dt_ns * 1e-6)

    def one_block(block: FloatArray) -> Values:
        tail = block[:, -fit_samples:].astype(float)
        usable = (np.isfinite(tail) & (tail > 0)).all(axis=1)
        slopes = np.full(len(tail), np.nan)
        slopes[usable] = np.log(tail[usable]) @ weights
        return slopes

    return _by_blocks(one_block, waveforms, shortest=fit_samples)


def decay_constant_us(tail_slope_per_ms: npt.ArrayLike) -> Values:
    """Decay constant in µs of a tail slope in 1/ms; infinite for a slope of 0.

    Examples
    --------
    >>> decay_constant_us([-20.0, 0.0])
    array([50., inf])
    """
    slope = np.asarray(tail_slope_per_ms, dtype=float)
    with np.errstate(divide="ignore"):
        # abs() of the zero keeps a flat tail at +inf whatever the sign of its zero
        return np.where(slope == 0, np.inf, -1e3 / slope)


def pulse_parameters(
    pulses: Pulses, preparation: PreparationConfig, scores: ScoreConfig
) -> dict[str, Values]:
    """All parameters of `PARAMETERS`, each an array with one value per pulse.

    Parameters
    ----------
    pulses
        Prepared pulses.
    preparation
        Says how many samples of the tail are fitted.
    scores
        Says at which fraction of the maximum the drift time begins.

    Returns
    -------
    dict
        ``current_amplitude`` in pulse heights per sample, ``drift_time`` in ns and
        ``tail_slope`` in 1/ms.
    """
    waveforms = pulses.waveforms
    return {
        "current_amplitude": current_amplitude(waveforms),
        "drift_time": drift_time(waveforms, pulses.dt_ns, scores.drift_start_fraction),
        "tail_slope": tail_slope(waveforms, pulses.dt_ns, preparation.decay_fit_samples),
    }


def _by_blocks(
    function: Callable[[FloatArray], Values], waveforms: FloatArray, shortest: int
) -> Values:
    """Apply `function` to blocks of pulses that have at least `shortest` samples."""
    if waveforms.ndim != 2 or waveforms.shape[1] < shortest:
        raise CpunetError(
            f"waveforms have shape {waveforms.shape}; "
            f"expected (pulses, samples) with {shortest} samples or more"
        )
    values = np.empty(len(waveforms))
    for first in range(0, len(waveforms), BLOCK):
        rows = slice(first, first + BLOCK)
        # dspeed's processors know float32 and float64 only
        values[rows] = function(np.ascontiguousarray(waveforms[rows], dtype=np.float32))
    return values


def _current_amplitude(waveforms: FloatArray) -> Values:
    from dspeed.processors import avg_current

    n, length = waveforms.shape
    current = np.empty((n, length - 1), np.float32)
    avg_current(waveforms, 1, current)
    if length - 1 <= NEIGHBOURHOOD:
        values: Values = _averaged(current).max(axis=1).astype(float)
        return values

    first = current.argmax(axis=1) - NEIGHBOURHOOD // 2
    first = np.clip(first, 0, length - 1 - NEIGHBOURHOOD)[:, np.newaxis]
    near = np.take_along_axis(current, first + np.arange(NEIGHBOURHOOD), axis=1)
    # averages near the ends of the neighbourhood are not those of the whole pulse
    inner = slice(REACH * UPSAMPLING, (NEIGHBOURHOOD - REACH) * UPSAMPLING)
    values = _averaged(near)[:, inner].max(axis=1).astype(float)

    # samples that no average left out of `inner` can see
    sample = np.arange(length - 1)
    inside = (sample >= first + 2 * REACH) & (sample < first + NEIGHBOURHOOD - 2 * REACH)
    elsewhere = np.where(inside, -np.inf, current).max(axis=1)
    unsure = ~(elsewhere <= values)
    if unsure.any():
        values[unsure] = _averaged(current[unsure]).max(axis=1)
    return values


def _averaged(current: FloatArray) -> FloatArray:
    """The current on the fine grid, smoothed by the moving averages."""
    from dspeed.processors import moving_window_multi, upsampler

    n, samples = current.shape
    # dspeed centres each sample, so the grid's end is not filled: leave it off
    fine = np.empty((n, (samples - 1) * UPSAMPLING), np.float32)
    upsampler(current, UPSAMPLING, fine)
    smooth: FloatArray = np.empty_like(fine)
    moving_window_multi(fine, AVERAGE_STEPS, AVERAGES, 0, smooth)
    return smooth
