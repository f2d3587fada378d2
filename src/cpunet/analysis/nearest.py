"""Which measured pulses are most like given ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.analysis.paired import BLOCK, Values, align_half_maximum
from cpunet.pulses.container import FloatArray

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Nearest:
    """Measured pulses most like each of some others.

    Parameters
    ----------
    index
        Rows of the measured set, shape ``(n, count)``, the nearest first.
    rms
        RMS difference to each, in units of the pulse height.
    unaligned
        Measured pulses left out because the edge region about the crossing of half of
        their maximum is not all in their window.
    """

    index: Indices
    rms: Values
    unaligned: int


def nearest_pulses(edges: FloatArray, measured: FloatArray, count: int) -> Nearest:
    """Find the measured pulses with the least RMS difference from each of some edges.

    Noise counts as difference.

    Parameters
    ----------
    edges
        Pulses aligned at half maximum by `align_half_maximum`, with as many samples before
        it as after it: shape ``(n, 2 * edge_samples)``.
    measured
        Prepared windows, ``(m, samples)``, which are aligned likewise.
    count
        How many to find; all, if fewer can be aligned.

    Raises
    ------
    CpunetError
        If the arrays are no pulses.
    """
    half = edges.shape[1] // 2
    best = np.zeros((len(edges), 0))
    rows = np.zeros((len(edges), 0), np.int64)
    unaligned = 0
    for first in range(0, len(measured), BLOCK):
        block = align_half_maximum(measured[first : first + BLOCK], half, half)
        usable = np.flatnonzero(np.isfinite(block).all(axis=1))
        unaligned += len(block) - len(usable)
        found = np.hstack(
            [best, _mean_squares(edges.astype(float), block[usable].astype(float))]
        )
        where = np.hstack([rows, np.broadcast_to(first + usable, (len(edges), len(usable)))])
        order = np.argsort(found, axis=1, kind="stable")[:, :count]
        best = np.take_along_axis(found, order, axis=1)
        rows = np.take_along_axis(where, order, axis=1)
    return Nearest(rows, np.sqrt(best), unaligned)


def _mean_squares(a: Values, b: Values) -> Values:
    """Mean square difference of each row of `a` from each of `b`."""
    squares = (a**2).sum(axis=1)[:, np.newaxis] + (b**2).sum(axis=1) - 2 * a @ b.T
    return np.asarray(np.maximum(squares, 0) / a.shape[1])
