"""Find the measured pulses most similar to given ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.pulses.container import FloatArray
from cpunet.pulses.half_maximum import BLOCK, Values, align_half_maximum

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Nearest:
    """Measured pulses nearest to each of the given pulses.

    Parameters
    ----------
    index
        Rows of the measured dataset, shape ``(n, count)``, the nearest first.
    rms
        RMS difference from each, in units of the pulse height.
    unaligned
        Number of measured pulses left out because their window contains too little of the
        edge region around half maximum.
    """

    index: Indices
    rms: Values
    unaligned: int


def nearest_pulses(
    edges: FloatArray,
    measured: FloatArray,
    count: int,
    before: int | None = None,
    least: float = 1.0,
) -> Nearest:
    """Find the measured pulses with the smallest RMS difference from each given edge.

    Noise contributes to the difference.

    Parameters
    ----------
    edges
        Pulses aligned at half maximum by `align_half_maximum`, shape ``(n, samples)``.
    measured
        Prepared windows of shape ``(m, samples)``, which are aligned in the same way.
    count
        Number of pulses to find; all, if fewer can be aligned.
    before
        Samples of the edges before half maximum; half of them if None.
    least
        Fraction of the known samples of the edges that a measured window must contain.
        Samples known in both are compared.

    Raises
    ------
    CpunetError
        If the arrays do not have the shape of pulses.
    """
    before = edges.shape[1] // 2 if before is None else before
    best = np.zeros((len(edges), 0))
    rows = np.zeros((len(edges), 0), np.int64)
    unaligned = 0
    for first in range(0, len(measured), BLOCK):
        block = align_half_maximum(
            measured[first : first + BLOCK], before, edges.shape[1] - before
        )
        known = np.isfinite(block).mean(axis=1)
        usable = np.flatnonzero(known >= least * np.isfinite(edges).mean(axis=1).max(initial=0))
        usable = usable[known[usable] > 0]
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
    """Mean square difference of each row of `a` from each of `b`, where both are known."""
    in_a, in_b = (np.isfinite(values).astype(float) for values in (a, b))
    a, b = np.nan_to_num(a), np.nan_to_num(b)
    squares = a**2 @ in_b.T + in_a @ (b**2).T - 2 * a @ b.T
    count = in_a @ in_b.T
    return np.where(count > 0, np.maximum(squares, 0) / np.maximum(count, 1), np.inf)
