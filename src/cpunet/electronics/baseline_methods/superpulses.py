"""Superpulses: mean currents of pulses with similar rise times, aligned at half maximum.

Simulated and measured pulses are of different events, so single pulses cannot be compared.
Their means can, once both datasets are divided at the same quantiles of rise time. Pulses of
one slice then originate from the same regions of the detector.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from cpunet.electronics.baseline_methods.base import Values
from cpunet.electronics.baseline_methods.window_response import Spectrum
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import tail_slope

Groups = list[npt.NDArray[np.int64]]

SLICES = 8
SINGLE_SITE = 0.35  # fraction of the pulses of a slice that is kept
TAIL_SHARE = 0.75  # of the samples after the alignment: 300 of 400, as in the paper
RISE_START, RISE_END = 0.02, 0.95  # above the noise at the start, below the slow top


@dataclass(frozen=True, eq=False)
class Superpulses:
    """Spectra of the mean currents, shape ``(slices, frequencies)``.

    ``error`` is the squared standard error of the mean. It includes noise and the differences
    between pulses within a slice.
    """

    spectra: Spectrum
    error: Values


def tail_samples(length: int, align: int) -> int:
    """Number of samples at the end of a window that contain only the decay."""
    return max(3, int(TAIL_SHARE * (length - align)))


def fitted_tail_slope(data: FloatArray, dt_ns: float, align: int) -> float:
    """Median logarithmic slope of the tails, in 1/ms.

    Raises
    ------
    CpunetError
        If no tail is positive.
    """
    slopes = tail_slope(data, dt_ns, tail_samples(data.shape[1], align))
    slopes = slopes[np.isfinite(slopes)]
    if not slopes.size:
        raise CpunetError("no measured pulse has a positive tail; check their polarity")
    return float(np.median(slopes))


def without_decay(
    data: FloatArray, tail_slope_per_ms: float, dt_ns: float, align: int
) -> Values:
    r"""Undo the decay (pole-zero correction) and scale the pulses to unit height.

    .. math:: x_j = \sum_{k \le j} \left(s_k - e^{\lambda \Delta t} s_{k-1}\right)

    with the logarithmic slope :math:`\lambda` of the tail.

    Parameters
    ----------
    data
        Windows of shape ``(n, length)`` with the baseline at 0.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    dt_ns
        Sampling period in ns.
    align
        Sample at which the windows are aligned.

    Examples
    --------
    An exponential decay becomes a step.

    >>> decay = np.r_[np.zeros(10), np.exp(-np.arange(30) * 0.016 / 50)]  # 50 us
    >>> without_decay(decay[np.newaxis], -20.0, 16.0, 10)[0, [9, 10, 39]].round(6).tolist()
    [0.0, 1.0, 1.0]
    """
    kept = np.exp(tail_slope_per_ms * dt_ns * 1e-6)
    current = data.astype(float)
    current[:, 1:] -= kept * data[:, :-1]
    steps = np.cumsum(current, axis=1)
    heights = steps[:, -tail_samples(data.shape[1], align) :].mean(axis=1, keepdims=True)
    return np.asarray(steps / heights, float)


def crossing(steps: Values, fraction: float) -> Values:
    """Sample at which each pulse of unit height last rises through a fraction.

    The sample is interpolated linearly. It is NaN if there is no crossing before `RISE_END`.

    Examples
    --------
    >>> crossing(np.array([[0.0, 0.0, 0.4, 0.8, 1.0, 1.0]]), 0.5)
    array([2.25])
    """
    samples = np.arange(steps.shape[1])
    top = (steps >= RISE_END).argmax(axis=1)[:, np.newaxis]
    below = (steps < fraction) & (samples < top)
    last = steps.shape[1] - 1 - below[:, ::-1].argmax(axis=1)
    last = np.minimum(last, steps.shape[1] - 2)
    rows = np.arange(len(steps))
    low, high = steps[rows, last], steps[rows, last + 1]
    known = below.any(axis=1)
    rise = np.where(known, high - low, 1.0)
    return np.asarray(np.where(known, last + (fraction - low) / rise, np.nan), float)


def rise_times(steps: Values) -> Values:
    """Rise times from 2 to 95 % of pulses of unit height in samples; NaN if undefined."""
    return crossing(steps, RISE_END) - crossing(steps, RISE_START)


def slices(current: Values) -> Groups:
    """Rows of single-site-like pulses between quantiles of rise time.

    The pulses with the highest current in each slice are kept. They differ far less from
    each other than multi-site pulses, and so do their means between datasets.

    Parameters
    ----------
    current
        Currents of pulses of unit height, shape ``(n, length)``.

    Raises
    ------
    CpunetError
        If too few pulses rise from baseline to top.
    """
    rise = rise_times(np.cumsum(current, axis=1))
    rows = np.flatnonzero(np.isfinite(rise))
    if len(rows) < 2 * SLICES / SINGLE_SITE:
        raise CpunetError(
            f"only {len(rows)} of {len(current)} pulses rise from baseline to top; "
            "check that they are prepared charge pulses"
        )
    # Over three samples, the peak hardly depends on the sampling phase.
    height = (current[:, :-2] + current[:, 1:-1] + current[:, 2:]).max(axis=1)
    ordered = rows[np.argsort(rise[rows], kind="stable")]
    return [
        group[np.argsort(height[group])[-int(np.ceil(SINGLE_SITE * len(group))) :]]
        for group in np.array_split(ordered, SLICES)
    ]


def superpulses(
    spectra: Spectrum,
    half_times: Values,
    groups: Groups,
    length: int,
) -> Superpulses:
    r"""Mean current spectra by slice, with the half maximum of each pulse at sample 0.

    .. math:: \bar{X}_k = \frac{1}{n} \sum_p X_{pk}\, e^{2 \pi i k t_p / N}

    with the half maximum :math:`t_p` of pulse :math:`p` in samples.

    Parameters
    ----------
    spectra
        Spectra of the currents, shape ``(n, length // 2 + 1)``.
    half_times
        Sample of the half maximum of each pulse, finite in all groups.
    groups
        Rows of each slice.
    length
        Number of samples of the records.
    """
    turn = 2j * np.pi * scipy.fft.rfftfreq(length)
    means = np.empty((len(groups), spectra.shape[1]), complex)
    error = np.empty(means.shape)
    for k, rows in enumerate(groups):
        moved = spectra[rows] * np.exp(half_times[rows, np.newaxis] * turn)
        means[k] = moved.mean(axis=0)
        error[k] = moved.var(axis=0) / max(1, len(rows) - 1)
    return Superpulses(means, error)
