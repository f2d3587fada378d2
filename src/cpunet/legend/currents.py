"""Currents of a pulse-shape library: about their maxima, and beyond the crystal.

The current of a template is averaged three times over 48 ns, like that of A in A/E, and
shifted so that its maximum is at sample `PEAK`.  The shift includes the fraction of a sample,
since half a nanosecond already changes the summed current of two sites.

Readers of a library interpolate drift times between nodes and take the template of the nearest
one.  At the surface, some nodes of a cell are outside the crystal; rings of nodes beyond it
give hits just inside their values.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cpunet.pulses.container import FloatArray

WINDOW, WINDOWS = 48, 3  # length of a moving average in ns, and number of averages
PEAK, LENGTH = 1000, 4001  # sample of the maximum, and length of a template in ns
MODE_BINS = 1000
RINGS = 3  # number of rings
_NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))

Floats = npt.NDArray[np.float32]
Values = npt.NDArray[np.float64]


def currents_about_peak(charge: FloatArray) -> tuple[Floats, Values]:
    """Average the currents, and shift their maxima to sample `PEAK`.

    Parameters
    ----------
    charge
        Charge sampled every nanosecond, 0 before the first sample, shape ``(n, samples)`` with
        3 samples or more.

    Returns
    -------
    currents
        Currents in units of the charge per ns, shape ``(n, LENGTH)``; 0 outside the record,
        rows of NaN for templates that contain NaN or have no maximum above 0.
    times_ns
        Times of the maxima after the first sample, shape ``(n,)``, including the delay of the
        backward averages, which is the same for all templates; NaN for rows of NaN.
    """
    n, n_samples = charge.shape
    currents, times = np.full((n, LENGTH), np.nan, np.float32), np.full(n, np.nan)
    for row, template in enumerate(charge):
        current = averaged(template.astype(np.float64))
        peak = 1 + int(current[1:-1].argmax())
        low, mid, high = current[peak - 1 : peak + 2]
        bend = low - 2 * mid + high
        # the running sums remain NaN after a NaN
        if np.isnan(current[-1]) or not (mid > 0 and bend < 0):
            continue
        times[row] = peak + 0.5 * (low - high) / bend
        first = int(times[row])
        f = times[row] - first
        # cubic interpolation with the slopes of the neighbours (Catmull and Rom)
        weights = (
            0.5 * f * (-1 + f * (2 - f)),
            0.5 * (2 + f * f * (3 * f - 5)),
            0.5 * f * (1 + f * (4 - 3 * f)),
            0.5 * f * f * (f - 1),
        )
        length = n_samples - 3
        between = sum(w * current[k : k + length] for k, w in enumerate(weights))
        begin = PEAK + 1 - first  # place of their first, which follows sample 1
        currents[row] = 0
        into = slice(max(begin, 0), begin + length)
        currents[row, into] = between[max(-begin, 0) : LENGTH - begin]
    return currents, times


def averaged(charge: Values, width: int = 1) -> Values:
    """Currents of charge along the last axis, 1 ns a sample, averaged three times over 48 ns.

    The charge of a sample arrives evenly over `width` ns. From a NaN on, currents are NaN.
    """
    current = np.diff(charge, prepend=0.0)
    for size in (width, *(WINDOW,) * WINDOWS):
        total = np.cumsum(current, axis=-1)
        current = total.copy()
        current[..., size:] -= total[..., :-size]
        current /= size
    return np.asarray(current)


def most_frequent(amplitudes: Values) -> float:
    """Mode of A/E as in production: centre of the fullest of 1,000 bins of the whole range.

    If all values are the same, it is their value.

    Parameters
    ----------
    amplitudes
        Finite values, at least one.

    Examples
    --------
    >>> round(most_frequent(np.array([1.0, 2.0, 2.0, 3.0])), 2)
    2.0
    >>> most_frequent(np.full(3, 0.0081))
    0.0081
    """
    if np.ptp(amplitudes) == 0:  # the bins would be 0.001/ns wide, a tenth of A/E
        return float(amplitudes[0])
    counts, edges = np.histogram(amplitudes, MODE_BINS)
    highest = int(counts.argmax())
    return float(0.5 * (edges[highest] + edges[highest + 1]))


def add_rings(templates: Floats, times: Values, rings: int = RINGS) -> None:
    """Fill nodes without a template, ring by ring, from their eight neighbours, in place.

    A new template is the mean of the neighbours' ones: the mean of currents that are aligned at
    their maxima has the mean A/E.  A new drift time is the mean of the linear extrapolations
    from two nodes in each of eight directions, or else the mean of its neighbours.

    Parameters
    ----------
    templates
        Templates, shape ``(r, z, samples)``, NaN if there is none.
    times
        Their drift times in ns, shape ``(r, z)``, NaN at the same nodes.
    rings
        Number of rings; a node depends only on nodes at most this far away.

    Examples
    --------
    >>> line = np.array([[[1.0], [3.0], [np.nan], [np.nan]]], np.float32)
    >>> times = np.array([[4.0, 6.0, np.nan, np.nan]])
    >>> add_rings(line, times, 1)
    >>> line[0, :, 0].tolist(), times[0].tolist()
    ([1.0, 3.0, 3.0, nan], [4.0, 6.0, 8.0, nan])
    """
    n_r, n_z = times.shape
    for _ in range(rings):
        padded = np.pad(times, 2, constant_values=np.nan)
        near, far = (
            np.stack([padded[2 + n * i :, 2 + n * j :][:n_r, :n_z] for i, j in _NEIGHBOURS])
            for n in (1, 2)
        )
        along, mean = (
            np.ma.masked_invalid(values).mean(axis=0).filled(np.nan)
            for values in (2 * near - far, near)
        )
        held = np.isfinite(near)
        new_r, new_z = np.nonzero(np.isnan(times) & held.any(axis=0))
        total = np.zeros((len(new_r), templates.shape[2]))
        for (i, j), inside in zip(_NEIGHBOURS, held[:, new_r, new_z], strict=True):
            total[inside] += templates[new_r[inside] + i, new_z[inside] + j]
        templates[new_r, new_z] = total / held.sum(axis=0)[new_r, new_z, np.newaxis]
        times[new_r, new_z] = np.where(np.isnan(along), mean, along)[new_r, new_z]


def padded_axis(axis: Values, before: int, after: int) -> Values:
    """Continue an ascending axis by its widest step on both sides.

    Examples
    --------
    >>> padded_axis(np.array([0.0, 0.5, 1.0]), 0, 2).tolist()
    [0.0, 0.5, 1.0, 1.5, 2.0]
    """
    step = float(np.diff(axis).max())
    low = axis[0] - step * np.arange(before, 0, -1)
    high = axis[-1] + step * np.arange(1, after + 1)
    return np.concatenate([low, axis, high])
