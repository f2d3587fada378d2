"""Mean pulses in slices of rise time: where in the detector a translation is wrong.

Pulses of one slice come from the same regions of the detector and differ by their sites
and by noise.  Their mean, aligned at half maximum, is the slice's mean pulse.  Its standard
error is determined, so a difference of simulation and data can be distinguished from chance.

Pulses are ordered by their rise time from 1 to 90 % (``rise_01_90``), which starts with the
pulse and ends while it still rises.  The paper's drift time ends at the maximum, which on a
flat top depends on the noise and would smear the slices.

The slices are bounded by quantiles of the rise times of the *data*.  Each method is sliced
by its own rise times: a method with the wrong response has different events in a slice, which
counts against it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import Values, align_half_maximum

BEFORE_NS, AFTER_NS = 1600.0, 2400.0  # of a mean pulse before and after half maximum
SLICES = 4


@dataclass(frozen=True, eq=False)
class MeanPulse:
    """The mean of pulses aligned at half maximum.

    Attributes
    ----------
    mean, error
        Mean and its standard error, shape ``(before + after,)``, in pulse heights; NaN where
        fewer than 2 pulses contribute.  Errors of neighbouring samples are correlated.
    n
        Number of pulses in the mean.
    """

    mean: Values
    error: Values
    n: int

    @classmethod
    def of(cls, aligned: FloatArray) -> Self:
        """Average pulses from `align_half_maximum`; those not aligned are left out.

        Sums are in float64: those of ten thousand float32 are off by a part of their error.
        """
        count = np.isfinite(aligned).sum(axis=0)
        mean = np.nansum(aligned, axis=0, dtype=float) / np.maximum(count, 1)
        squares = np.nansum((aligned - mean) ** 2, axis=0)
        error = np.sqrt(squares / np.maximum(count - 1, 1) / np.maximum(count, 1))
        mean, error = (np.where(count >= 2, values, np.nan) for values in (mean, error))
        return cls(mean, error, int(np.isfinite(aligned).any(axis=1).sum()))


@dataclass(frozen=True, eq=False)
class Slices:
    """The mean pulses of a dataset by rise time.

    Attributes
    ----------
    whole
        Mean of all pulses.
    pulses, edges
        Mean pulse of each slice, and the edges of the slices in ns.
    """

    whole: MeanPulse
    pulses: tuple[MeanPulse, ...]
    edges: Values


def slice_edges(rise_time: Values, slices: int = SLICES) -> Values:
    """Edges of slices with equal numbers of measured pulses.

    Parameters
    ----------
    rise_time
        Rise times of the measured pulses in ns; NaN and infinity are ignored.
    slices
        Number of slices; one more edge is returned, in ns.

    Examples
    --------
    >>> slice_edges(np.arange(101.0), slices=4)
    array([  0.,  25.,  50.,  75., 100.])
    """
    finite = rise_time[np.isfinite(rise_time)]
    return np.quantile(finite, np.linspace(0, 1, slices + 1))


def around_half(windows: FloatArray, dt_ns: float) -> FloatArray:
    """Pulses from `BEFORE_NS` before their half maximum to `AFTER_NS` after it."""
    before, after = round(BEFORE_NS / dt_ns), round(AFTER_NS / dt_ns)
    return align_half_maximum(windows, before, after)


def aligned_means(
    windows: Callable[[str], FloatArray], rise_time: Mapping[str, Values], dt_ns: float
) -> dict[str, Slices]:
    """Mean pulses of each method, in the same slices for all.

    Parameters
    ----------
    windows
        Prepared pulses of a method, shape ``(n, length)``.
    rise_time
        Their rise times in ns by method, those of the measured pulses under ``"data"``.
    dt_ns
        Sampling period in ns.
    """
    edges = slice_edges(rise_time["data"])
    return {
        method: sliced(around_half(windows(method), dt_ns), times, edges)
        for method, times in rise_time.items()
    }


def sliced(aligned: FloatArray, rise_time: Values, edges: Values) -> Slices:
    """Mean pulse of each slice.

    Parameters
    ----------
    aligned
        Pulses aligned by `align_half_maximum`, shape ``(n, samples)``.
    rise_time
        Rise time of each pulse in ns, shape ``(n,)``.
    edges
        Edges of the slices in ns, see `slice_edges`; the last slice includes its upper edge.
    """
    inside = (rise_time >= edges[0]) & (rise_time <= edges[-1])  # not those that are NaN
    place = np.searchsorted(edges[1:-1], rise_time, side="right")
    means = tuple(MeanPulse.of(aligned[inside & (place == i)]) for i in range(len(edges) - 1))
    return Slices(MeanPulse.of(aligned), means, edges)
