"""Read NumPy files: ``.npz`` with columns of values per event, ``.npy`` without."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.energies import MemoryColumn
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import Layout, PulseSource, Traces
from cpunet.tables import shortened

_WAVEFORMS = ("waveform", "waveforms", "values")

Arrays = dict[str, npt.NDArray[Any]]


def read_arrays(path: Path) -> Arrays:
    """Arrays of an ``.npz`` by name, or the array of an ``.npy``, called ``""``, as a map.

    Arrays of objects are left out: they would be pickles, which can execute code.

    Raises
    ------
    CpunetError
        If the file cannot be read.
    """
    try:
        arrays: Arrays = {}
        with path.open("rb") as stream:  # NumPy would leave a truncated file open
            if stream.read(2) != b"PK":
                return {"": np.load(path, mmap_mode="r", allow_pickle=False)}
            stream.seek(0)
            content = np.load(stream, allow_pickle=False)
            for name in content.files:
                with suppress(ValueError):  # an array of objects
                    arrays[name] = content[name]
        return arrays
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        text = " ".join(str(error).split())
        raise CpunetError(
            f"{path}: cannot be read as NumPy file ({text[:160]}); write it again"
        ) from error


class ArraySource(PulseSource):
    """An array of shape ``(events, samples)``.

    The waveforms of an ``.npz`` are ``waveform``, ``waveforms`` or ``values``, or the array
    that the option ``table`` names. Arrays with one value per event, such as ``dt_ns`` (or
    ``dt``), energies and event numbers, are columns.
    """

    def __init__(self, options: PulseFile) -> None:
        arrays = read_arrays(options.path)
        name = _waveform_name(options, arrays)
        self._values = arrays[name]
        if self._values.dtype.kind not in "iuf":
            raise CpunetError(
                f"{options.path}: array {name or 'in it'} is of {self._values.dtype}; save "
                "plain numbers"
            )
        columns = {
            name: MemoryColumn(values)
            for name, values in arrays.items()
            if values.ndim <= 1 and values.dtype.kind in "iufb"
        }
        super().__init__(
            options, Layout.of_array(options.path, "NumPy", name, self._values.shape, columns)
        )

    def _traces(self, size: int) -> Iterator[Traces]:
        for start in range(0, len(self._values), size):
            yield Traces(self._values[start : start + size])


class MemorySource(PulseSource):
    """Pulses in memory."""

    def __init__(self, options: PulseFile, pulses: Pulses) -> None:
        self._in_memory = pulses
        columns = {
            "energy_kev": MemoryColumn(pulses.energy_kev),
            "event_number": MemoryColumn(pulses.event_number),
            "dt_ns": MemoryColumn(np.array(pulses.dt_ns)),
        }
        shape = pulses.waveforms.shape
        super().__init__(options, Layout.of_array(options.path, "memory", "", shape, columns))

    def _traces(self, size: int) -> Iterator[Traces]:
        for start in range(0, len(self._in_memory), size):
            yield Traces(self._in_memory.waveforms[start : start + size])


def _waveform_name(options: PulseFile, arrays: Arrays) -> str:
    matrices = [name for name, values in arrays.items() if values.ndim == 2]
    if options.table is not None:
        if options.table not in matrices:
            raise CpunetError(
                f"{options.path}: no array {options.table} of two dimensions; "
                f"there are {shortened(matrices)}"
            )
        return options.table
    named = [name for name in _WAVEFORMS if name in matrices] or matrices
    if not named:
        raise CpunetError(
            f"{options.path}: no waveforms in it; it holds {shortened(arrays)}; "
            "give an array of two dimensions (event, sample)"
        )
    if len(named) > 1:
        raise CpunetError(
            f"{options.path}: {len(named)} arrays of two dimensions ({shortened(named)}); "
            "choose one with `table` (`sim_table`, `data_table`)"
        )
    return named[0]
