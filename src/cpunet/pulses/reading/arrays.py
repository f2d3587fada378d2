"""Pulses of NumPy files: ``.npz`` with columns beside the waveforms, ``.npy`` without."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.reading.columns import MemoryColumn, shortened
from cpunet.pulses.reading.source import Layout, PulseSource, ReadOptions, Traces

# What NumPy and zipfile raise on damaged files: headers are parsed as Python source,
# and a damaged shape asks for more memory than there is.
_DAMAGED = (
    OSError,
    ValueError,
    EOFError,
    OverflowError,
    MemoryError,
    SyntaxError,
    TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
_WAVEFORMS = ("waveform", "waveforms", "values")


@dataclass(frozen=True)
class _Header:
    shape: tuple[int, ...]
    by_columns: bool
    dtype: np.dtype[Any]


class ArraySource(PulseSource):
    """An array of two dimensions (event, sample), read row by row.

    An ``.npz`` may hold ``dt_ns`` (or ``dt``), energies and event numbers beside
    ``waveform``, ``waveforms`` or ``values``; `table` names another array.
    Pickled objects are never loaded.
    """

    def __init__(self, options: ReadOptions) -> None:
        with _readable(options.path):
            headers = _headers(options.path)
            self._key = _waveform_key(options, headers)
            header = headers[self._key]
            columns = _columns(options.path, headers)
        _require_plain(options.path, self._key, header)
        self._header = header
        period_name = "dt_ns" if "dt_ns" in columns else "dt"
        layout = Layout(
            format="NumPy",
            table=self._key,
            n_pulses=header.shape[0],
            length=header.shape[1],
            columns=columns,
            period_name=period_name,
            period=columns.get(period_name),
        )
        super().__init__(options, layout)

    def _traces(self, size: int) -> Iterator[Traces]:
        row_bytes = self.length * self._header.dtype.itemsize
        with _readable(self.path), _member(self.path, self._key) as file:
            _read_header(file)
            for start in range(0, self._header.shape[0], size):
                n_rows = min(size, self._header.shape[0] - start)
                data = file.read(n_rows * row_bytes)
                if len(data) < n_rows * row_bytes:
                    row = start + len(data) // row_bytes
                    raise CpunetError(
                        f"{self.path}: event {row}: the file is cut off; write it again"
                    )
                rows = np.frombuffer(data, self._header.dtype)
                yield Traces(rows.reshape(n_rows, self.length))


def _waveform_key(options: ReadOptions, headers: dict[str, _Header]) -> str:
    matrices = [key for key, header in headers.items() if len(header.shape) == 2]
    if options.table is not None:
        if options.table not in matrices:
            raise CpunetError(
                f"{options.path}: no array {options.table} of two dimensions; "
                f"there are {shortened(matrices)}"
            )
        return options.table
    named = [key for key in _WAVEFORMS if key in matrices] or matrices
    if not named:
        raise CpunetError(
            f"{options.path}: no waveforms in it; it holds {shortened(headers)}; "
            "give an array of two dimensions (event, sample)"
        )
    if len(named) > 1:
        raise CpunetError(
            f"{options.path}: {len(named)} arrays of two dimensions ({shortened(named)}); "
            "choose one with --table"
        )
    return named[0]


def _require_plain(path: Path, key: str, header: _Header) -> None:
    if header.dtype.kind not in "iuf":
        raise CpunetError(
            f"{path}: array {key or 'in it'} is of {header.dtype}; save plain numbers"
        )
    if header.by_columns and min(header.shape) > 1:
        raise CpunetError(
            f"{path}: array {key or 'in it'} is stored column by column, "
            "so that no row can be read alone; save numpy.ascontiguousarray of it"
        )


def _columns(path: Path, headers: dict[str, _Header]) -> dict[str, MemoryColumn]:
    """The small arrays, read whole: a few bytes per event."""
    columns: dict[str, MemoryColumn] = {}
    for key, header in headers.items():
        if len(header.shape) <= 1 and header.dtype.kind in "iufb":
            with _member(path, key) as file:
                values: npt.NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
            columns[key] = MemoryColumn(values)
    return columns


def _headers(path: Path) -> dict[str, _Header]:
    found: dict[str, _Header] = {}
    for key in _keys(path):
        with _member(path, key) as file:
            found[key] = _read_header(file)
    return found


def _keys(path: Path) -> list[str]:
    if not zipfile.is_zipfile(path):
        return [""]
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    return [name.removesuffix(".npy") for name in names if name.endswith(".npy")]


@contextmanager
def _member(path: Path, key: str) -> Iterator[IO[bytes]]:
    """The ``.npy`` part of that name, or (``""``) the file itself."""
    if not key:
        with path.open("rb") as file:
            yield file
    else:
        with zipfile.ZipFile(path) as archive, archive.open(f"{key}.npy") as part:
            yield part


def _read_header(file: IO[bytes]) -> _Header:
    read = (
        np.lib.format.read_array_header_1_0
        if np.lib.format.read_magic(file) == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, by_columns, dtype = read(file)
    return _Header(shape, by_columns, dtype)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGED as error:
        raise CpunetError(
            f"{path}: cannot be read as NumPy file ({error}); write it again"
        ) from error
