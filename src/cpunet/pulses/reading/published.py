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
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened
from cpunet.pulses.reading.energies import MemoryColumn
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import Layout, PulseSource, Traces, choose_table

WAVEFORMS, DETECTOR = "raw_waveform", "detector"
_NUMBERS = (DETECTOR, "run_number", "id")  # beside the waveforms, in every file
_RENAMED = {"energy_label": ("energy", "keV"), "id": ("event_number", "")}
_SLAB_BYTES = 1 << 25  # of traces read at a time


def is_majorana(file: h5py.File) -> bool:
    """Whether a file has the layout of the release."""
    traces = file.get(WAVEFORMS)
    if not isinstance(traces, h5py.Dataset) or traces.ndim != 2:
        return False
    return all(is_column(file.get(name)) for name in _NUMBERS)


def detectors(file: h5py.File) -> list[str]:
    """The detectors of a file, by the release's numbers."""
    return [str(number) for number in np.unique(file[DETECTOR][()])]


class MajoranaSource(PulseSource):
    """The traces of one detector; `table` is its number, or ``raw_waveform`` for all."""

    def __init__(self, options: PulseFile) -> None:
        path = options.path
        with opened(path) as file:
            dataset = file[WAVEFORMS]
            self._rows = _rows(options, file, dataset.shape[0])
            columns = {
                name: MemoryColumn(values[self._rows], units)
                for name, values, units in _columns(file)
            }
            layout = Layout(
                format="Majorana release",
                table=options.table or WAVEFORMS,
                n_pulses=len(self._rows),
                length=dataset.shape[1],
                columns=columns,
                period_hint="the Majorana Demonstrator's digitisers ran at 100 MHz: 10",
            )
        super().__init__(options, layout)

    def _traces(self, size: int) -> Iterator[Traces]:
        rows = self._single()
        while some := list(islice(rows, size)):
            yield Traces(np.stack(some))

    def _single(self) -> Iterator[npt.NDArray[np.float32]]:
        # whole slabs: row by row, the chunks of a compressed file would be unpacked repeatedly
        with opened(self.path) as file:
            dataset = file[WAVEFORMS]
            slab = max(1, _SLAB_BYTES // (dataset.dtype.itemsize * self.length))
            for start in range(0, dataset.shape[0], slab):
                chosen = self._rows[np.searchsorted(self._rows, start) :]
                chosen = chosen[chosen < start + slab] - start
                if len(chosen):
                    with np.errstate(over="ignore"):  # overflows become infinite
                        found = dataset[start : start + slab][chosen].astype(np.float32)
                    yield from found


def _rows(options: PulseFile, file: h5py.File, n: int) -> npt.NDArray[np.int64]:
    """Rows of the chosen detector, in order."""
    if options.table == WAVEFORMS:
        return np.arange(n)
    remedy = f"choose one with `table`, or all with `table` {WAVEFORMS}"
    chosen = choose_table(options, detectors(file), "detector", "detectors", remedy)
    return np.flatnonzero(file[DETECTOR][()].astype(str) == chosen)


def _columns(file: h5py.File) -> Iterator[tuple[str, npt.NDArray[np.generic], str]]:
    """Yield name, values and units of each column beside the traces (a few bytes per event)."""
    for name in file:
        column = file.get(name)
        if not is_column(column) or column.ndim == 0:
            continue
        shown, units = _RENAMED.get(name, (name, ""))
        yield shown, np.asarray(column[()]), units


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


@dataclass(frozen=True)
class PickledPulse:
    """One entry: its samples, the numbers beside them by name, and its event number."""

    samples: npt.NDArray[np.float32]
    numbers: dict[str, float]
    event: int


class TruncatedError(Exception):
    """The pickle is truncated or damaged."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise CpunetError(
                f"asks for {module}.{name}, which no list of pulses needs; refused, nothing of "
                "it was executed"
            )
        return super().find_class(module, name)


def entries(path: Path) -> Iterator[Any]:
    """Yield the objects pickled one after the other in a file, and the items of lists.

    Raises
    ------
    CpunetError
        If the file cannot be read or asks for more than arrays and plain containers.
    TruncatedError
        If it is truncated or damaged; the objects before that are yielded first.
    """
    try:
        stream = path.open("rb")
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror})") from error
    with stream:
        while stream.peek(1):
            try:
                value = _Unpickler(stream).load()
            except CpunetError as error:
                raise CpunetError(f"{path}: {error}") from error
            except Exception as error:  # a damaged pickle can raise anything
                raise TruncatedError(str(error) or type(error).__name__) from error
            if isinstance(value, list | tuple):
                yield from value
            else:
                yield value


def as_pulse(entry: Any, number: int) -> PickledPulse | str:
    """Convert an entry to a pulse; the reason, if it is not one.

    Parameters
    ----------
    entry
        Any unpickled object.
    number
        Its index in the file, which replaces a missing event number.
    """
    if not isinstance(entry, dict) or "wf" not in entry:
        return "no dictionary with wf"
    try:
        with np.errstate(over="ignore"):  # values beyond single precision are counted later
            samples = np.asarray(entry["wf"], np.float32)
        event = int(entry.get("event", number))
        numbers = dict.fromkeys(("tp0", "energy"), float("nan"))
        for name, value in entry.items():
            if name in numbers or name == "dc_label":
                numbers[name] = float(value)
    except (TypeError, ValueError, OverflowError):
        return "holds something other than numbers"
    if samples.ndim != 1 or not len(samples):
        return "its wf is no trace"
    return PickledPulse(samples, numbers, event)


@dataclass
class _Seen:
    """Numbers of the pulses read so far (a few bytes each), since columns are read by rows."""

    path: Path
    numbers: list[dict[str, float]] = field(default_factory=list)
    complete: bool = False

    def pulses(self) -> Iterator[PickledPulse]:
        """Yield all pulses of the file in order and keep their numbers."""
        length, place = 0, -1
        try:
            for place, entry in enumerate(entries(self.path)):
                pulse = as_pulse(entry, place)
                if isinstance(pulse, str):
                    raise CpunetError(
                        f"{self.path}: entry {place} is no pulse ({pulse}); {_OTHERS}"
                    )
                length = length or len(pulse.samples)
                if len(pulse.samples) != length:
                    raise CpunetError(
                        f"{self.path}: entry {place}: {len(pulse.samples)} samples, before it "
                        f"{length}; {_OTHERS}"
                    )
                if place == len(self.numbers):
                    self.numbers.append(pulse.numbers)
                yield pulse
        except TruncatedError as error:
            said = " ".join(str(error).split())
            raise CpunetError(
                f"{self.path}: breaks off after {place + 1} entries ({said}); download it again"
            ) from error
        self.complete = True

    def until(self, stop: float) -> list[dict[str, float]]:
        """Numbers of at least the first `stop` pulses, or of all if there are fewer."""
        if len(self.numbers) < stop and not self.complete:
            for met, _ in enumerate(self.pulses(), start=1):
                if met >= stop:
                    break
        return self.numbers


@dataclass(frozen=True)
class _PickledColumn:
    """One number per pulse; parts of the file that were not read yet are read when needed."""

    seen: _Seen
    name: str
    units: str = ""
    constant: bool = False

    def __len__(self) -> int:
        return len(self.seen.until(np.inf))

    def read(self, start: int, stop: int) -> npt.NDArray[Any]:
        """Values of the events `start` to `stop` - 1."""
        rows = self.seen.until(stop)[start:stop]
        return np.array([row.get(self.name, np.nan) for row in rows], float)


class PickleSource(PulseSource):
    """Pickled dictionaries, one after the other (streamed) or in lists (held one at a time)."""

    def __init__(self, options: PulseFile) -> None:
        if options.table is not None:
            raise CpunetError(
                f"{options.path}: a file of pickled pulses has no tables; leave out `table`"
            )
        self._seen = _Seen(options.path)
        first = next(self._seen.pulses(), None)
        known = {} if first is None else first.numbers
        layout = Layout(
            format="pickled pulses",
            table="",
            n_pulses=0 if first is None else None,
            length=0 if first is None else len(first.samples),
            columns={
                name: _PickledColumn(self._seen, name, "keV" if name == "energy" else "")
                for name in known
            },
            period_hint="CPU-Net's pulses are sampled every 16 ns",
        )
        super().__init__(options, layout)

    def _traces(self, size: int) -> Iterator[Traces]:
        pulses = self._seen.pulses()
        while some := list(islice(pulses, size)):
            numbers = np.array([pulse.event for pulse in some], np.int64)
            yield Traces(np.stack([pulse.samples for pulse in some]), numbers)
