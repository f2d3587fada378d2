"""The true pulses of a virtual test stand, and how far translated pulses are from them.

Two pulses are compared after both are shifted to cross half of their maximum at the same
time: a time shift left by the electronics or the alignment is not a difference of shape.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypedDict

import numpy as np
import numpy.typing as npt

from cpunet.electronics.finishing import BLOCK as FINISHED
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.half_maximum import BLOCK, aligned_block
from cpunet.pulses.loading import InputSet
from cpunet.pulses.reading.arrays import read_arrays

Values = npt.NDArray[np.float64]


class Responses:
    """Noise-free traces of the simulated pulses in use, block by block.

    Parameters
    ----------
    path
        ``.npz`` file with ``response``, shape (pulses of the simulation file, samples).
    sim
        Simulated pulses in use.

    Raises
    ------
    CpunetError
        If the file is not readable or belongs to other pulses.
    """

    def __init__(self, path: Path, sim: InputSet) -> None:
        self._index = sim.prepared.index
        arrays = read_arrays(path)
        if "response" not in arrays:
            names = ", ".join(arrays) or "none"
            raise CpunetError(f"{path}: has no array 'response' (found {names})")
        values = arrays["response"]
        if values.ndim != 2 or values.shape[0] != sim.prepared.n_read:
            raise CpunetError(
                f"{path}: response has shape {values.shape}, but {sim.path} holds "
                f"{sim.prepared.n_read} pulses; give the truth of that file"
            )
        self._path, self._values = path, values

    def blocks(self, size: int = FINISHED) -> Iterator[FloatArray]:
        """Float32 traces of the pulses in use, in order, `size` at a time.

        Raises
        ------
        CpunetError
            At the end, if none of them is finite.
        """
        traces, finite = self._values, False
        waiting = np.empty((0, traces.shape[1]), np.float32)
        for first in range(0, len(traces), size):
            rows = traces[first : first + size]
            begin, end = np.searchsorted(self._index, [first, first + len(rows)])
            chosen = rows[self._index[begin:end] - first].astype(np.float32)
            finite = finite or bool(np.isfinite(chosen).all(axis=1).any())
            waiting = np.concatenate([waiting, chosen])
            if len(waiting) >= size:
                yield waiting[:size]
                waiting = waiting[size:]
        if len(waiting):
            yield waiting
        if len(self._index) and not finite:
            raise CpunetError(f"{self._path}: no response is finite; give noise-free traces")


class PairedScores(TypedDict):
    """RMS differences of pulse pairs in units of the full charge, and pairs left out."""

    rmse: float
    edge_rmse: float
    unaligned: int


def pair_squares(
    methods: Mapping[str, FloatArray], truth: FloatArray, edge_samples: int
) -> dict[str, Values]:
    """Squared differences from the true shapes, pulse by pulse, aligned at half maximum.

    Parameters
    ----------
    methods
        Translated pulses by method, shape ``(n, length)``.
    truth
        True shapes of the same events, of the same shape.
    edge_samples
        Half-width of the edge window in samples.

    Returns
    -------
    dict
        Arrays of shape ``(n, 4)`` by method: sum of squares and number of samples, over all
        samples that both records of a pair have, and over the ``2 * edge_samples + 1`` samples
        around the crossing; all 0 where a pulse cannot be aligned.
    """
    found = {method: np.zeros((len(truth), 4)) for method in methods}
    for first in range(0, len(truth), BLOCK):
        rows = slice(first, first + BLOCK)
        half = truth.shape[1]
        aligned = aligned_block(truth[rows], half, half)
        edge = slice(max(half - edge_samples, 0), half + edge_samples + 1)
        for method, translated in methods.items():
            difference = aligned_block(translated[rows], half, half)
            difference -= aligned
            found[method][rows, :2] = _squares(difference)
            found[method][rows, 2:] = _squares(difference[:, edge])
    return found


def scores_of_squares(squares: Values) -> PairedScores:
    r"""Root-mean-square differences from the truth, from the result of `pair_squares`.

    .. math:: \mathrm{RMSE} = \sqrt{\frac{1}{N} \sum_{p, k} (x_{pk} - y_{pk})^2}

    over pulses :math:`p` and samples :math:`k`.

    Returns
    -------
    dict
        ``rmse`` and ``edge_rmse`` in units of the full charge (NaN if no pair is left), and
        ``unaligned``, the number of pairs left out because one of the two does not cross
        half of its maximum.

    Examples
    --------
    A time shift is no difference of shape:

    >>> import numpy as np
    >>> time = np.arange(100)
    >>> early, late = np.array([1 / (1 + np.exp((t0 - time) / 3)) for t0 in (40, 50)])
    >>> squares = pair_squares({"ren": late[None]}, early[None], edge_samples=10)
    >>> round(scores_of_squares(squares["ren"])["rmse"], 6)
    0.0
    """
    total = squares.sum(axis=0)
    return {
        "rmse": _root_mean(total[:2]),
        "edge_rmse": _root_mean(total[2:]),
        "unaligned": int((squares[:, 1] == 0).sum()),
    }


def _squares(difference: Values) -> Values:
    """Sum of squares of the values that are not NaN, and their number, row by row."""
    known = np.isfinite(difference)
    values = np.where(known, difference, 0)
    return np.stack([np.einsum("ij,ij->i", values, values), known.sum(axis=1)], axis=1)


def _root_mean(sum_and_count: Values) -> float:
    total, count = sum_and_count
    return float(np.sqrt(total / count)) if count else float("nan")
