"""Pulses in the formats of siggen and its users: ``.spe`` spectra and columns of text."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.reading.columns import MemoryColumn
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import Layout, PulseSource, Traces

# Radware's spectrum, written by siggen's `stester`: one Fortran record of 24 bytes
# (8 of title, channels, rows, two unused), then one of float32, each enclosed by its length.
_SPE = struct.Struct("<i8siiiiii")

_MIN_N = 16  # samples: shorter lines are not pulses but some other table
_PRINTED = "signal:"  # the line that siggen's `psig` prints before the numbers
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


class _Line(NamedTuple):
    number: int
    values: list[float]


class TextSource(PulseSource):
    """Text in one of four formats; ``#`` starts a comment, commas may separate numbers.

    Lines of one number are the samples of one pulse.  Lines of two numbers are its times
    (ns, evenly spaced) and values.  Longer lines are one pulse each.  After a line
    ``signal:``, as printed by siggen, all numbers are one pulse.
    """

    def __init__(self, options: PulseFile) -> None:
        path = options.path
        first, second = [*islice(_lines(path), 2), None, None][:2]
        if first is None:
            raise CpunetError(f"{path}: holds no numbers; give a file of pulses")
        period = None
        self._pulse: npt.NDArray[np.float64] | None = None
        if _is_printed(path):
            numbers = chain.from_iterable(line.values for line in _lines(path))
            self._pulse = np.fromiter(numbers, np.float64)
        elif len(first.values) <= 2 and second is not None:
            columns = np.array(list(_even_lines(path, len(first.values))))
            self._pulse = columns[:, -1]
            if len(first.values) == 2:
                period = MemoryColumn(_spacing(path, columns[:, 0]), "ns")
        length = len(first.values) if self._pulse is None else len(self._pulse)
        if length < _MIN_N:
            raise CpunetError(
                f"{path}: {length} numbers are no pulse; give time (ns) and value, "
                "or one pulse a line"
            )
        n_pulses = None if self._pulse is None else 1
        super().__init__(options, Layout("text", "", n_pulses, length, {}, "time", period))

    def _traces(self, size: int) -> Iterator[Traces]:
        if self._pulse is not None:
            yield Traces(self._pulse[np.newaxis])
            return
        lines = _even_lines(self.path, self.length)
        while rows := list(islice(lines, size)):
            yield Traces(np.array(rows))


def _even_lines(path: Path, expected: int) -> Iterator[list[float]]:
    for line in _lines(path):
        if len(line.values) != expected:
            raise CpunetError(
                f"{path}: line {line.number}: {len(line.values)} numbers, before it "
                f"{expected}; give every line the same length"
            )
        yield line.values


def _lines(path: Path) -> Iterator[_Line]:
    """Yield the numbers of each line that has any."""
    any_line = False
    with path.open(encoding="ascii", errors="replace") as file:
        for number, line in enumerate(file, 1):
            words = line.partition("#")[0].replace(",", " ").split()
            if words == [_PRINTED]:
                if any_line:
                    raise CpunetError(
                        f"{path}: line {number}: another pulse; give each a file of its own"
                    )
                continue
            try:
                values = [float(word) for word in words]
            except ValueError:
                raise CpunetError(
                    f"{path}: line {number}: {line.strip()[:40]!r} is no line of numbers; "
                    "give a file of pulses, or start comments with #"
                ) from None
            if values:
                any_line = True
                yield _Line(number, values)


def _is_printed(path: Path) -> bool:
    with path.open(encoding="ascii", errors="replace") as file:
        return next((line.strip() for line in file if line.strip()), "") == _PRINTED


def _spacing(path: Path, time_ns: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    step = (time_ns[-1] - time_ns[0]) / (len(time_ns) - 1)
    even = time_ns[0] + step * np.arange(len(time_ns))
    if not (step > 0 and np.abs(time_ns - even).max() < _UNEVEN * step):
        raise CpunetError(
            f"{path}: its first column is no evenly rising time; give time (ns) and value, "
            "or one pulse a line"
        )
    return np.asarray(step)
