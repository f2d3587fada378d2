"""Arrays of pulses: in memory, NumPy's ``.npz`` and ``.npy``, and pickles.

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
from cpunet.pulses.reading.columns import Column
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import PulseSource
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
    return PulseSource.of_array(options.path, "memory", "", pulses.waveforms, columns)


def read_numpy(options: PulseFile) -> PulseSource:
    """Read a NumPy file.

    The waveforms of an ``.npz`` are ``waveform``, ``waveforms`` or ``values``, or the array
    that the option ``table`` names. Arrays with one value per event, such as ``dt_ns`` (or
    ``dt``), energies and event numbers, are columns.
    """
    arrays = read_arrays(options.path)
    matrices = [name for name, values in arrays.items() if values.ndim == 2]
    if not matrices:
        raise CpunetError(
            f"{options.path}: no waveforms in it; it holds {shortened(arrays)}",
            "give an array of two dimensions (event, sample)",
        )
    usual = [name for name in _WAVEFORMS if name in matrices and options.place is None]
    name = options.chosen_of(usual or matrices, "array", "arrays of two dimensions")
    if (kind := arrays[name].dtype).kind not in "iuf":
        raise CpunetError(
            f"{options.path}: array {name or 'in it'} is of {kind}; save plain numbers"
        )
    columns = {
        column: Column.of(values.ravel() if values.ndim else values)
        for column, values in arrays.items()
        if (values.ndim <= 1 or 1 in values.shape)
        and values.dtype.kind in "iufb"
        and column != name
    }
    return PulseSource.of_array(options.path, "NumPy", name, arrays[name], columns)


# NumPy 1 calls its package numpy.core, NumPy 2 numpy._core
_ALLOWED = {("numpy", "dtype"), ("numpy", "ndarray"), ("_codecs", "encode")} | {
    (f"numpy.{core}.{module}", name)
    for core in ("core", "_core")
    for module, name in (
        ("multiarray", "_reconstruct"),
        ("multiarray", "scalar"),
        ("numeric", "_frombuffer"),
    )
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
    return PulseSource.of_array(path, "pickled pulses", "", waveforms, columns)


READERS = {"memory": read_memory, "NumPy": read_numpy, "pickle": read_pickles}
