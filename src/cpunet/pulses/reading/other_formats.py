"""Pulses in memory, of NumPy's ``.npz`` and ``.npy``, of pickles and of FlashCam's ``.fcio``.

The authors of CPU-Net published files of pickled dictionaries.  The layout is that of the
README of their repository (kevinhbhimani/CPU-Net on GitHub) for the record
10.5281/zenodo.15311838: files such as ``fep_wf_ornl.pickle`` and ``fep_wf_sim.pickle``, in
which one pickle follows the other, each a dictionary ``{wf, tp0, energy}`` of samples, index of
the rise and energy in keV; their ``dataset.py`` also knows ``event`` and ``dc_label``.  A
pickle is a program that can call any function by name; only the names with which NumPy stores
arrays and numbers are allowed.

FlashCam digitiser files are read through the ``fcio`` library.
"""

from __future__ import annotations

import os
import pickle
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import Column, PulseSource
from cpunet.tables import shortened

if TYPE_CHECKING:  # a fifth of a second
    from fcio import FCIO

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
        text = f"{options.path}: no waveforms in it; it holds {shortened(held)}"
        raise CpunetError(text, "give an array of two dimensions (event, sample)")
    usual = [name for name in _WAVEFORMS if name in matrices and options.place is None]
    name = options.chosen_of(usual or matrices, "array", "arrays of two dimensions")
    numbers = {n: v for n, v in arrays.items() if v.dtype.kind in "iufb" and n != name}
    numbers = {n: v for n, v in numbers.items() if v.ndim <= 1 or 1 in v.shape}
    columns = {n: Column.of(v.ravel() if v.ndim else v) for n, v in numbers.items()}
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


def read_flashcam(options: PulseFile) -> PulseSource:
    """The traces of one channel; `table` is its index if there are several.

    Full and sparse events are both read; events without the channel are skipped.
    The energy of the digitiser's own filter is not in keV and is not read.
    """
    path, stream = options.path, _open(options.path)
    channels = [str(channel) for channel in range(int(stream.config.adcs))]
    name = options.chosen_of(channels, "channel", "channels")
    length, period_ns = int(stream.config.eventsamples), float(stream.config.sampling_period_ns)
    ahead, end, numbers = _events(path, int(name), length, stream), 0, list[int]()

    def rows(start: int, stop: int) -> npt.NDArray[np.uint16]:
        nonlocal ahead, end
        if start < end:  # the stream is opened again to begin anew
            ahead = _events(path, int(name), length, _open(path))
        some = list(islice(ahead, stop - start))
        end, numbers[start:] = start + len(some), [number for _, number in some]
        return np.array([trace for trace, _ in some], np.uint16).reshape(-1, length)

    times = {"dt": Column.of(np.asarray(period_ns), "ns")} if period_ns > 0 else {}
    source = PulseSource(path, "FlashCam", name, None, length, rows, times=times)
    source.of_each["event_number"], source.close = numbers, stream.close
    return source


def _events(
    path: Path, channel: int, length: int, stream: FCIO
) -> Iterator[tuple[npt.NDArray[np.uint16], int]]:
    """Traces of a channel and numbers of their events, in the order of the stream.

    The last record of a truncated file looks like an event: each event is yielded only after
    the next record, or the regular end, has been read.
    """
    last: tuple[npt.NDArray[np.uint16], int] | None = None
    any_record = False
    for is_event in _records(path, stream):
        any_record = True
        if last is not None:
            yield last
        last, event = None, stream.event
        if is_event and len(row := np.flatnonzero(event.trace_list == channel)):
            last = event.trace[row[0]].copy(), int(event.eventnumber)
            if (samples := len(last[0])) != length:
                text = f"{path}: event {last[1]}: {samples} samples, before it {length}"
                raise CpunetError(text, "split the file by length")
    # The library also reports an error if nothing follows the configuration, and from
    # 0.9 on none where a file is cut off.
    size = 0 if path.suffix in (".gz", ".zst") else path.stat().st_size
    if (stream.tag < 0 or stream.read_bytes() < size) and any_record:
        after = "" if last is None else f"event {last[1]}: "
        raise CpunetError(f"{path}: {after}the file is cut off; copy it again")
    if last is not None:
        yield last


def channel_sizes(path: Path) -> dict[str, int | None]:
    """Number of traces of each channel that has any; None (not counted) for a single channel.

    Raises
    ------
    CpunetError
        If the file cannot be read or is damaged.
    """
    stream, counts = _open(path), Counter[int]()
    if stream.config.adcs == 1:
        return {"0": None}
    for is_event in _records(path, stream):
        counts.update(map(int, stream.event.trace_list if is_event else ()))
    return {str(c): counts[c] for c in sorted(counts)}


def _records(path: Path, stream: FCIO) -> Iterator[bool]:
    """Read record by record; whether each is an event."""
    from fcio import Tags

    try:
        while stream.get_record():
            yield stream.tag in (Tags.Event, Tags.SparseEvent)
    except Exception as error:  # the library raises various errors on damaged records
        said = " ".join(str(error).split())
        raise CpunetError(f"{path}: damaged ({said}); copy it again") from error


def _open(path: Path) -> FCIO:
    from fcio import fcio_open

    # the C library writes a harmless warning about older files
    stderr, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        stream = fcio_open(str(path))
    except Exception as error:  # the library raises various errors on damaged records
        raise CpunetError(f"{path}: cannot be read as FlashCam file; copy it again") from error
    finally:
        os.dup2(stderr, 2)
        os.close(sink)
        os.close(stderr)
    if stream.config is None:
        raise CpunetError(f"{path}: holds no configuration; copy it again")
    return stream


READERS = {
    "memory": read_memory,
    "NumPy": read_numpy,
    "pickle": read_pickles,
    "FlashCam": read_flashcam,
}
