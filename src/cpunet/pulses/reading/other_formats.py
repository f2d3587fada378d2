"""Pulses in memory, of NumPy's ``.npz`` and ``.npy``, and of pickles.

The authors of CPU-Net published files of pickled dictionaries.  The layout is that of the
README of their repository (kevinhbhimani/CPU-Net on GitHub) for the record
10.5281/zenodo.15311838: files such as ``fep_wf_ornl.pickle`` and ``fep_wf_sim.pickle``, in
which one pickle follows the other, each a dictionary ``{wf, tp0, energy}`` of samples, index of
the rise and energy in keV; their ``dataset.py`` also knows ``event`` and ``dc_label``.  A
pickle is a program that can call any function by name; only the names with which NumPy stores
arrays and numbers are allowed.
"""

from __future__ import annotations

import pickle
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


def _of_array(
    path: Path, format: str, name: str, values: npt.NDArray[Any], columns: dict[str, Column]
) -> PulseSource:
    (n, length), rows = values.shape, lambda start, stop: values[start:stop]
    return PulseSource(path, format, name, n, length, rows, columns)


def read_memory(options: PulseFile) -> PulseSource:
    """Pulses in memory."""
    pulses = options.pulses
    assert pulses is not None  # which are read in place of a file
    names = ("energy_kev", "event_number", "dt_ns")
    columns = {name: Column.of(np.asarray(getattr(pulses, name))) for name in names}
    source = _of_array(options.path, "memory", "", pulses.waveforms, columns)
    source.times["t0"] = Column.of(pulses.t0_ns, "ns")
    return source


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
    return _of_array(options.path, "NumPy", name, arrays[name], columns)


# NumPy 1 calls its package numpy.core, NumPy 2 numpy._core
_CORE = {"_reconstruct": "multiarray", "scalar": "multiarray", "_frombuffer": "numeric"}
_ALLOWED = {("numpy", "dtype"), ("numpy", "ndarray"), ("_codecs", "encode")}
_ALLOWED |= {
    (f"numpy.{core}.{_CORE[name]}", name) for core in ("core", "_core") for name in _CORE
}
_OTHERS = "write the pulses of one length without other entries"


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise CpunetError(
                f"asks for {module}.{name}, which no list of pulses needs; refused, nothing of "
                "it was executed"
            )
        return super().find_class(module, name)


def read_pickles(options: PulseFile) -> PulseSource:
    """Read pickled dictionaries, one after the other or in lists; all are held in memory.

    Raises
    ------
    CpunetError
        If the file is damaged, asks for more than arrays and plain containers, or holds more
        than pulses of one length.
    """
    path = options.path
    if options.table is not None:
        raise CpunetError(f"{path}: a file of pickled pulses has no tables; leave out `table`")
    entries = list[Any]()
    with path.open("rb") as stream:
        while stream.peek(1):
            try:
                value = _Unpickler(stream).load()
            except CpunetError as error:
                raise CpunetError(f"{path}: {error}") from error
            except Exception as error:  # a damaged pickle can raise anything
                raise CpunetError(
                    f"{path}: breaks off after {len(entries)} entries "
                    f"({' '.join(str(error).split())}); download it again"
                ) from error
            entries += value if isinstance(value, list | tuple) else [value]
    traces, events = list[npt.NDArray[np.float32]](), list[int]()
    numbers = list[dict[str, float]]()
    for place, entry in enumerate(entries):
        try:
            with np.errstate(over="ignore"):  # values beyond single precision are counted later
                trace = np.asarray(entry["wf"], np.float32)
            events.append(int(entry.get("event", place)))
            names = entry.keys() & {"tp0", "energy", "dc_label"}
            numbers.append({name: float(entry[name]) for name in names})
        except (TypeError, ValueError, LookupError, AttributeError, OverflowError) as error:
            raise CpunetError(
                f"{path}: entry {place} is no pulse (a dictionary of wf and numbers); {_OTHERS}"
            ) from error
        length = len(traces[0]) if traces else trace.size
        if trace.shape != (length,):
            raise CpunetError(
                f"{path}: entry {place}: {trace.size} samples, before it {length}; {_OTHERS}"
            )
        traces.append(trace)
    columns = {"event_number": Column.of(np.array(events, np.int64))}
    for name in sorted(set().union(*numbers)):
        values = np.array([row.get(name, np.nan) for row in numbers])
        columns[name] = Column.of(values, "keV" if name == "energy" else "")
    waveforms = np.stack(traces) if traces else np.empty((0, 0), np.float32)
    return _of_array(path, "pickled pulses", "", waveforms, columns)


READERS = {
    "memory": read_memory,
    "NumPy": read_numpy,
    "pickle": read_pickles,
}
