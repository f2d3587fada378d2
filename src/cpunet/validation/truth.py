"""The true pulses of a virtual test stand, for comparison with translated pulses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cpunet.electronics.finishing import BLOCK
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.loading import InputSet
from cpunet.pulses.reading.arrays import read_arrays

_NAME = "response"


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
        self.path = path
        self._index = sim.prepared.index
        arrays = read_arrays(path)
        if _NAME not in arrays:
            names = ", ".join(arrays) or "none"
            raise CpunetError(f"{path}: has no array '{_NAME}' (found {names})")
        values = arrays[_NAME]
        if values.ndim != 2 or values.shape[0] != sim.prepared.n_read:
            raise CpunetError(
                f"{path}: response has shape {values.shape}, but {sim.path} holds "
                f"{sim.prepared.n_read} pulses; give the truth of that file"
            )
        if values.dtype.kind not in "iuf":
            raise CpunetError(f"{path}: response is of {values.dtype}; give traces")
        self._values = values

    def blocks(self, size: int = BLOCK) -> Iterator[FloatArray]:
        """Float32 traces of the pulses in use, in order, `size` at a time.

        Raises
        ------
        CpunetError
            If none of the traces is finite.
        """
        traces = self._values
        waiting = np.empty((0, traces.shape[1]), np.float32)
        finite = not len(self._index)
        for first in range(0, len(traces), size):
            rows = traces[first : first + size]
            begin, end = np.searchsorted(self._index, [first, first + len(rows)])
            chosen = rows[self._index[begin:end] - first].astype(np.float32)
            finite = finite or bool(np.isfinite(chosen).all(axis=1).any())
            waiting = np.concatenate([waiting, chosen])
            if len(waiting) > size:  # the last block waits for the check below
                yield waiting[:size]
                waiting = waiting[size:]
        if not finite:
            raise CpunetError(f"{self.path}: no response is finite; give noise-free traces")
        if len(waiting):
            yield waiting
