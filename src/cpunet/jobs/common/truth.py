"""The true pulses of a virtual test stand, for comparison with translated pulses."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from cpunet import npz_files
from cpunet.electronics.finishing import BLOCK
from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import InputSet
from cpunet.pulses.container import FloatArray

_NAME = "response"
_MAX_SAMPLES = 1 << 20


class Responses:
    """Noise-free traces of the simulated pulses in use, read block by block.

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
        with self._readable():
            if path.is_file() and not zipfile.is_zipfile(path):
                raise ValueError("not an archive of arrays")
            headers = npz_files.headers(path)
        if _NAME not in headers:
            names = ", ".join(headers) or "none"
            raise CpunetError(f"{path}: has no array '{_NAME}' (found {names})")
        shape, dtype = headers[_NAME].shape, headers[_NAME].dtype
        if len(shape) != 2 or shape[0] != sim.prepared.n_read:
            raise CpunetError(
                f"{path}: response has shape {shape}, but {sim.path} holds "
                f"{sim.prepared.n_read} pulses; give the truth of that file"
            )
        if dtype.kind not in "iuf" or not 2 <= shape[1] <= _MAX_SAMPLES:
            raise CpunetError(
                f"{path}: response is of {dtype}, {shape[1]} samples each; give traces"
            )
        if headers[_NAME].by_columns:
            raise CpunetError(
                f"{path}: response is stored column by column; "
                "save numpy.ascontiguousarray(response)"
            )
        self._shape, self._dtype = shape, dtype

    def blocks(self, size: int = BLOCK) -> Iterator[FloatArray]:
        """Float32 traces of the pulses in use, in order, `size` at a time.

        Raises
        ------
        CpunetError
            If the file is damaged, or none of its traces is finite.
        """
        n, samples = self._shape
        waiting, finite = np.empty((0, samples), np.float32), not len(self._index)
        with self._readable(), npz_files.member(self.path, _NAME) as stream:
            npz_files.read_header(stream)
            for first in range(0, n, size):
                rows = min(size, n - first)
                raw = stream.read(rows * samples * self._dtype.itemsize)
                traces = np.frombuffer(raw, self._dtype).reshape(rows, samples)
                begin, end = np.searchsorted(self._index, [first, first + rows])
                chosen = traces[self._index[begin:end] - first].astype(np.float32)
                finite = finite or bool(np.isfinite(chosen).all(axis=1).any())
                waiting = np.concatenate([waiting, chosen])
                if len(waiting) > size:  # the last block waits for the check below
                    yield waiting[:size]
                    waiting = waiting[size:]
        if not finite:
            raise CpunetError(f"{self.path}: no response is finite; give noise-free traces")
        if len(waiting):
            yield waiting

    @contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except npz_files.DAMAGED as error:
            raise CpunetError(
                f"{self.path}: cannot be read as .npz ({npz_files.said(error)})"
            ) from error
