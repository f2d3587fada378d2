"""Published sets of pulses: those of the Majorana Demonstrator and of CPU-Net's authors.

The layout of the Majorana release for AI and machine learning (HDF5) is that of Table I of its
notes (arXiv:2308.10856; the files are 10.5281/zenodo.8257027): datasets at the top of the file,
one row per event, named ``raw_waveform`` (3,800 samples), ``energy_label`` (keV),
``psd_label_low_avse``, ``psd_label_high_avse``, ``psd_label_dcr``, ``psd_label_lq`` (1: passes
the cut), ``tp0``, ``detector``, ``run_number`` and ``id``.  The NPML files have neither
energies nor cuts.  Neither the notes' table nor the files give the sampling period.

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
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, reading
from cpunet.pulses.reading.columns import Column
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import PulseSource

WAVEFORMS, DETECTOR = "raw_waveform", "detector"
_NUMBERS = (DETECTOR, "run_number", "id")  # in every file, with the waveforms
_RENAMED = {"energy_label": ("energy", "keV"), "id": ("event_number", "")}


def is_majorana(file: h5py.File) -> bool:
    """Whether a file has the layout of the release."""
    traces = file.get(WAVEFORMS)
    if not isinstance(traces, h5py.Dataset) or traces.ndim != 2:
        return False
    return all(is_column(file.get(name)) for name in _NUMBERS)


def detectors(file: h5py.File) -> list[str]:
    """The detectors of a file, by the release's numbers."""
    return [str(number) for number in np.unique(file[DETECTOR][()])]


def read_majorana(options: PulseFile, file: h5py.File) -> PulseSource:
    """The traces of one detector; `table` is its number, or ``raw_waveform`` for all."""
    rows = np.arange(len(file[WAVEFORMS]))
    if options.table != WAVEFORMS:
        remedy = f"choose one with `table`, or all with `table` {WAVEFORMS}"
        chosen = options.chosen_of(detectors(file), "detector", "detectors", remedy)
        rows = np.flatnonzero(file[DETECTOR][()].astype(str) == chosen)
    columns = {}
    for name in file:
        item = file.get(name)
        if is_column(item) and item.ndim:
            shown, units = _RENAMED.get(name, (name, ""))
            columns[shown] = Column.of(item[()], units)
    path, name, values = options.path, options.place or WAVEFORMS, file[WAVEFORMS]
    hint = "the Majorana Demonstrator's digitisers ran at 100 MHz: 10"
    table = PulseSource.of_array(
        path, "Majorana release", name, values, columns, period_hint=hint
    )
    return replace(table, rows=reading(path, values, table.rows)).at(rows)


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
    traces: list[npt.NDArray[np.float32]] = []
    events: list[int] = []
    numbers: list[dict[str, float]] = []
    for place, entry in enumerate(_entries(path)):
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
    hint = "CPU-Net's pulses are sampled every 16 ns"
    waveforms = np.stack(traces) if traces else np.empty((0, 0), np.float32)
    return PulseSource.of_array(
        path, "pickled pulses", "", waveforms, columns, period_hint=hint
    )


def _entries(path: Path) -> Iterator[Any]:
    """Yield the objects pickled one after the other in a file, and the items of lists."""
    n_read = 0
    with path.open("rb") as stream:
        while stream.peek(1):
            try:
                value = _Unpickler(stream).load()
            except CpunetError as error:
                raise CpunetError(f"{path}: {error}") from error
            except Exception as error:  # a damaged pickle can raise anything
                said = " ".join(str(error).split())
                raise CpunetError(
                    f"{path}: breaks off after {n_read} entries ({said}); download it again"
                ) from error
            some = value if isinstance(value, list | tuple) else [value]
            n_read += len(some)
            yield from some
