"""The known answer of a test stand, made comparable with translated pulses."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from cpunet.electronics.finishing import BLOCK, finish
from cpunet.errors import CpunetError
from cpunet.jobs.inputs import InputSet
from cpunet.pulses.container import FloatArray
from cpunet.recipes.schema import PreparationConfig

_NAME = "response"


def load_truth(path: Path, sim: InputSet, config: PreparationConfig) -> FloatArray:
    """Read the noise-free response of each simulated pulse, prepared like data.

    Parameters
    ----------
    path, sim
        As for `Responses`.
    config
        The preparation of the run.

    Returns
    -------
    array
        Shape (pulses in use, window); NaN where a response cannot be prepared.

    Raises
    ------
    CpunetError
        If the file is not readable or belongs to other pulses.
    """
    blocks = Responses(path, sim).blocks()
    return np.concatenate([finish(block, config, dt_ns=sim.dt_ns) for block in blocks])


class Responses:
    """The noise-free traces of the simulated pulses in use, read block by block.

    Parameters
    ----------
    path
        ``.npz`` with ``response``, shape (pulses of the simulation file, samples).
    sim
        The simulated pulses in use.

    Raises
    ------
    CpunetError
        If the file is not readable or belongs to other pulses.
    """

    def __init__(self, path: Path, sim: InputSet) -> None:
        self.path = path
        self._index = sim.prepared.index
        with self._opened() as (_, shape, by_column, self._dtype):
            if len(shape) != 2 or shape[0] != sim.prepared.n_read:
                raise CpunetError(
                    f"{path}: response has shape {shape}, but {sim.path} holds "
                    f"{sim.prepared.n_read} pulses; give the truth of that file"
                )
        if by_column:
            raise CpunetError(
                f"{path}: response is stored column by column; "
                "save numpy.ascontiguousarray(response)"
            )
        self._shape = shape

    def blocks(self, size: int = BLOCK) -> Iterator[FloatArray]:
        """Float32 traces of `size` pulses in use at a time, in their order.

        Raises
        ------
        CpunetError
            If the file is damaged.
        """
        n, samples = self._shape
        waiting = np.empty((0, samples), np.float32)
        with self._opened() as (stream, *_):
            for first in range(0, n, size):
                rows = min(size, n - first)
                raw = stream.read(rows * samples * self._dtype.itemsize)
                traces = np.frombuffer(raw, self._dtype).reshape(rows, samples)
                begin, end = np.searchsorted(self._index, [first, first + rows])
                chosen = traces[self._index[begin:end] - first].astype(np.float32)
                waiting = np.concatenate([waiting, chosen])
                if len(waiting) >= size:
                    yield waiting[:size]
                    waiting = waiting[size:]
        if len(waiting):
            yield waiting

    @contextmanager
    def _opened(
        self,
    ) -> Iterator[tuple[IO[bytes], tuple[int, ...], bool, np.dtype[np.generic]]]:
        """Open the array behind its header: shape, whether by columns, and type."""
        try:
            with zipfile.ZipFile(self.path) as archive:
                names = [name.removesuffix(".npy") for name in archive.namelist()]
                if _NAME not in names:
                    raise CpunetError(
                        f"{self.path}: has no array '{_NAME}' "
                        f"(found {', '.join(names) or 'none'})"
                    )
                with archive.open(f"{_NAME}.npy") as stream:
                    yield stream, *_header(stream)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise CpunetError(f"{self.path}: cannot be read as .npz ({error})") from error


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[np.generic]]:
    version = np.lib.format.read_magic(stream)
    read = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, by_column, dtype = read(stream)
    if dtype.hasobject:
        raise ValueError("objects instead of numbers")
    return shape, by_column, dtype
