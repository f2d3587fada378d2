"""Pulses in memory, and of NumPy's ``.npz`` and ``.npy``."""

from __future__ import annotations

import zipfile
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import Column, PulseSource
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


def read_memory(options: PulseFile) -> PulseSource:
    """Pulses in memory."""
    pulses = options.pulses
    assert pulses is not None  # which are read in place of a file
    names = ("energy_kev", "event_number", "dt_ns")
    columns = {name: Column.of(np.asarray(getattr(pulses, name))) for name in names}
    rows, times = pulses.waveforms, {"t0": Column.of(pulses.t0_ns, "ns")}
    read = lambda start, stop: rows[start:stop]  # noqa: E731
    return PulseSource(
        options.path, "memory", "", len(rows), pulses.length, read, columns, times
    )


def read_numpy(options: PulseFile) -> PulseSource:
    """Read a NumPy file.

    The waveforms of an ``.npz`` are ``waveform``, ``waveforms`` or ``values``, or the array
    that the option ``table`` names. Arrays with one value per event, such as ``dt_ns`` (or
    ``dt``), energies and event numbers, are columns.
    """
    arrays = read_arrays(options.path)
    matrices = [n for n, v in arrays.items() if v.ndim == 2 and v.dtype.kind in "iuf"]
    if not matrices:
        held = (f"{n} {v.shape} of {v.dtype}".strip() for n, v in arrays.items())
        raise CpunetError(
            f"{options.path}: no waveforms in it; it holds {shortened(held)}",
            "give an array of two dimensions (event, sample)",
        )
    usual = [name for name in _WAVEFORMS if name in matrices and options.place is None]
    choices = usual or matrices
    name = choices[0] if options.place is None and len(choices) == 1 else options.place
    if name is None:
        raise CpunetError(
            f"{options.path}: {len(choices)} arrays of two dimensions ({shortened(choices)})",
            "choose one with `table` (`sim_table`, `data_table`)",
        )
    if name not in choices:
        raise CpunetError(f"{options.path}: no array {name}; there are {shortened(choices)}")
    numbers = {n: v for n, v in arrays.items() if v.dtype.kind in "iufb" and n != name}
    columns = {
        column: Column.of(values.ravel() if values.ndim else values)
        for column, values in numbers.items()
        if values.ndim <= 1 or 1 in values.shape
    }
    rows = arrays[name]
    read = lambda start, stop: rows[start:stop]  # noqa: E731
    return PulseSource(options.path, "NumPy", name, len(rows), rows.shape[1], read, columns)
