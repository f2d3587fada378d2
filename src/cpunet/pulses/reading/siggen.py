"""Pulses in the formats of siggen and its users: ``.spe`` spectra and text."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.reading.energies import MemoryColumn
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import Layout, PulseSource, Traces

# Radware's spectrum, written by siggen's `stester`: one Fortran record of 24 bytes
# (8 of title, channels, rows, two unused), then one of float32, each enclosed by its length.
_SPE = struct.Struct("<i8siiiiii")

_MIN_SAMPLES = 16  # samples: shorter lines are not pulses but some other table
_UNEVEN = 0.1  # of a step: times are printed with few digits


class SpectrumSource(PulseSource):
    """A ``.spe`` file: one pulse, or one per row of a two-dimensional spectrum."""

    def __init__(self, options: PulseFile) -> None:
        path = options.path
        with path.open("rb") as file:
            header = file.read(_SPE.size)
        _, _, length, n_rows, _, _, _, n_bytes = _SPE.unpack(header)
        size = path.stat().st_size
        if length < 1 or n_rows < 1 or n_bytes != 4 * length * n_rows:
            raise CpunetError(f"{path}: its header is damaged; write it again")
        if size < _SPE.size + n_bytes:
            raise CpunetError(
                f"{path}: is cut off after {max(size - _SPE.size, 0) // 4} of "
                f"{length * n_rows} samples; write it again"
            )
        super().__init__(options, Layout("siggen spectrum", "", n_rows, length))

    def _traces(self, size: int) -> Iterator[Traces]:
        with self.path.open("rb") as file:
            file.seek(_SPE.size)
            for start in range(0, self.n_pulses or 0, size):
                n_rows = min(size, (self.n_pulses or 0) - start)
                rows = np.fromfile(file, "<f4", n_rows * self.length)
                yield Traces(rows.reshape(n_rows, self.length))


class TextSource(PulseSource):
    """Text: one pulse a line, or lines of a pulse's times (ns, evenly spaced) and values.

    ``#`` starts a comment, commas may separate numbers.
    """

    def __init__(self, options: PulseFile) -> None:
        path = options.path
        first = next(_lines(path), None)
        if first is None:
            raise CpunetError(f"{path}: holds no numbers; give a file of pulses")
        length, period = len(first), None
        self._pulse: npt.NDArray[np.float64] | None = None
        if length == 2:
            time_ns, self._pulse = np.array(list(_lines(path))).T
            length = len(time_ns)
        if length < _MIN_SAMPLES:
            raise CpunetError(
                f"{path}: {length} numbers are no pulse; give time (ns) and value, "
                "or one pulse a line"
            )
        if self._pulse is not None:
            period = MemoryColumn(_spacing(path, time_ns), "ns")
        n_pulses = None if self._pulse is None else 1
        super().__init__(options, Layout("text", "", n_pulses, length, {}, "time", period))

    def _traces(self, size: int) -> Iterator[Traces]:
        if self._pulse is not None:
            yield Traces(self._pulse[np.newaxis])
            return
        lines = _lines(self.path)
        while rows := list(islice(lines, size)):
            yield Traces(np.array(rows))


def _lines(path: Path) -> Iterator[list[float]]:
    """Yield the numbers of each line that has any, as many in every line."""
    expected = None
    with path.open(encoding="ascii", errors="replace") as file:
        for number, line in enumerate(file, 1):
            words = line.partition("#")[0].replace(",", " ").split()
            try:
                values = [float(word) for word in words]
            except ValueError:
                raise CpunetError(
                    f"{path}: line {number}: {line.strip()[:40]!r} is no line of numbers; "
                    "give a file of pulses, or start comments with #"
                ) from None
            if not values:
                continue
            if len(values) != (expected := expected or len(values)):
                raise CpunetError(
                    f"{path}: line {number}: {len(values)} numbers, before it "
                    f"{expected}; give every line the same length"
                )
            yield values


def _spacing(path: Path, time_ns: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    step = (time_ns[-1] - time_ns[0]) / (len(time_ns) - 1)
    even = time_ns[0] + step * np.arange(len(time_ns))
    if not (step > 0 and np.abs(time_ns - even).max() < _UNEVEN * step):
        raise CpunetError(
            f"{path}: its first column is no evenly rising time; give time (ns) and value, "
            "or one pulse a line"
        )
    return np.asarray(step)
