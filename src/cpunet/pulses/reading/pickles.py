"""Pulses as the authors of CPU-Net published them: a file of pickled dictionaries.

The layout is that of the README of their repository (kevinhbhimani/CPU-Net on GitHub) for the
record 10.5281/zenodo.15311838: files such as ``fep_wf_ornl.pickle`` and ``fep_wf_sim.pickle``,
in which one pickle follows the other, each a dictionary ``{wf, tp0, energy}`` of samples, index
of the rise and energy in keV; their ``dataset.py`` also knows ``event`` and ``dc_label``.
A pickle is a program that can call any function by name; only the names with which NumPy
stores arrays and numbers are allowed.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import Layout, PulseSource, Traces

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
_PERIOD_HINT = "CPU-Net's pulses are sampled every 16 ns"
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
            period_hint=_PERIOD_HINT,
        )
        super().__init__(options, layout)

    def _traces(self, size: int) -> Iterator[Traces]:
        pulses = self._seen.pulses()
        while some := list(islice(pulses, size)):
            numbers = np.array([pulse.event for pulse in some], np.int64)
            yield Traces(np.stack([pulse.samples for pulse in some]), numbers)
