"""Pulse-shape parameters of prepared pulses: current amplitude, drift time, tail slope.

These are the three parameters by which the paper evaluates a translation (section 4.3).
Current amplitude and drift time are those of dspeed's processors, so they equal the values
of the experiments' production analysis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses import _parameter_kernels as kernels
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.recipes.schema import PreparationConfig, ScoreConfig

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """Label and unit of a parameter for an axis."""

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

# I_max as defined by Majorana and LEGEND: 16 steps per sample (1 ns for 16-ns records)
# and three moving averages over 48 steps.
UPSAMPLING = 16
AVERAGE_STEPS = 48
AVERAGES = 3

# Reach of the averages in samples: they cover 94 steps back and 47 ahead.
REACH = 8
# Samples around the steepest point that are searched first for the maximum.
NEIGHBOURHOOD = 96

BLOCK = 256  # pulses per block: bounds memory and keeps the buffers in the cache


def current_amplitude(waveforms: FloatArray) -> Values:
    r"""Maximum current of each pulse (A of A/E; the paper's I_max, section 4.3.2).

    .. math:: I_{\max} = \max_t \, (h * h * h * i)(t), \qquad i_k = x_{k+1} - x_k

    with the moving average :math:`h` over 48 steps of 1/16 sample, as defined by Majorana
    (arXiv:1901.05388).  It is the result of dspeed's processors
    ``avg_current(1)`` → ``upsampler(16)`` → ``moving_window_multi(48, 3, 0)`` → ``min_max``,
    whose arithmetic is repeated here for several pulses at once.

    Each value of that chain is a positively weighted mean of the current at most `REACH`
    samples away.  The chain is therefore first run only around the steepest point of a
    pulse.  If the current elsewhere exceeds the maximum found there, the whole pulse is
    processed.

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

    Examples
    --------
    A straight rise over 200 samples has a current of 1/200:

    >>> import numpy as np
    >>> ramp = np.clip(np.arange(-100.0, 300.0) / 200.0, 0, 1).astype(np.float32)
    >>> current_amplitude(ramp[np.newaxis]).round(6)
    array([0.005])
    """
    shortest = AVERAGE_STEPS // UPSAMPLING + 3
    return _by_blocks(_current_amplitude, waveforms, shortest)


def current_amplitude_kernel() -> npt.NDArray[np.float32]:
    """Weights of the current's samples on the fine grid of the current amplitude.

    Returns
    -------
    numpy.ndarray
        Float32, shape ``(16, 2 * REACH + 1)``: for each step within a sample, the weights of
        the current from `REACH` samples before to `REACH` samples after it.
    """
    fine = np.zeros(((4 * REACH + 1) * UPSAMPLING, 1), np.float32)
    centre = 2 * REACH * UPSAMPLING
    fine[centre - UPSAMPLING // 2 : centre + UPSAMPLING // 2] = 1  # a current of one sample
    smooth = np.empty_like(fine)
    for _ in range(AVERAGES):
        kernels.average(fine, AVERAGE_STEPS, smooth)
        fine, smooth = smooth, fine
    grid = fine[::-1].reshape(-1, UPSAMPLING)  # each average reverses the order
    around = grid[REACH : 3 * REACH + 1]
    # the response at sample j to a unit current at sample 0 is the weight of the current j
    # samples earlier
    return np.ascontiguousarray(around[::-1].T)


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

    def one_block(block: FloatArray) -> Values:
        end = block.argmax(axis=1)
        height = np.take_along_axis(block, end[:, np.newaxis], axis=1)
        start = kernels.crossings(block, start_fraction * height, end)[:, 0]
        return np.asarray((end - start) * dt_ns)

    return _by_blocks(one_block, waveforms, shortest=2)


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
    lever = np.arange(fit_samples) - (fit_samples - 1) / 2
    weights = lever / (lever @ lever) / (dt_ns * 1e-6)

    def one_block(block: FloatArray) -> Values:
        tail = block[:, -fit_samples:].astype(float)
        usable = (np.isfinite(tail) & (tail > 0)).all(axis=1)
        slopes = np.full(len(tail), np.nan)
        slopes[usable] = np.log(tail[usable]) @ weights
        return slopes

    return _by_blocks(one_block, waveforms, shortest=fit_samples)


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
    waveforms = pulses.waveforms
    return {
        "current_amplitude": current_amplitude(waveforms),
        "drift_time": drift_time(waveforms, pulses.dt_ns, scores.drift_start_fraction),
        "tail_slope": tail_slope(waveforms, pulses.dt_ns, preparation.decay_fit_samples),
    }


def _by_blocks(
    function: Callable[[FloatArray], Values], waveforms: FloatArray, shortest: int
) -> Values:
    """Apply `function` to blocks of pulses of at least `shortest` samples."""
    if waveforms.ndim != 2 or waveforms.shape[1] < shortest:
        raise CpunetError(
            f"waveforms have shape {waveforms.shape}; "
            f"expected (pulses, samples) with {shortest} samples or more"
        )
    values = np.empty(len(waveforms))
    for first in range(0, len(waveforms), BLOCK):
        rows = slice(first, first + BLOCK)
        values[rows] = function(np.ascontiguousarray(waveforms[rows], dtype=np.float32))
    return values


def _current_amplitude(waveforms: FloatArray) -> Values:
    n, length = waveforms.shape
    current, steepest = kernels.currents(waveforms)
    start = np.zeros(n, np.int64)
    if length - 1 <= NEIGHBOURHOOD:
        return _maximum(current, start, length - 1, 0)
    first = np.clip(steepest - NEIGHBOURHOOD // 2, 0, length - 1 - NEIGHBOURHOOD)
    # near the ends of the neighbourhood the averages differ from those of the whole pulse
    values = _maximum(current, first, NEIGHBOURHOOD, REACH)
    # samples that those averages do not reach
    elsewhere = kernels.maxima_elsewhere(current, first + 2 * REACH, NEIGHBOURHOOD - 4 * REACH)
    unsure = np.flatnonzero(~(elsewhere <= values))
    if len(unsure):
        values[unsure] = _maximum(current[unsure], start, length - 1, 0)
    return values


def _maximum(
    current: FloatArray, first: npt.NDArray[np.int64], samples: int, ends: int
) -> Values:
    """Maximum of the averaged current, excluding `ends` samples at each end."""
    ends *= UPSAMPLING
    found: FloatArray = kernels.averaged_maxima(
        current, first, samples, UPSAMPLING, AVERAGE_STEPS, AVERAGES, ends
    )
    return found.astype(float)
