"""Read pulses from NumPy files: ``.npz`` with columns of values per event, ``.npy`` without."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from cpunet import npz_files
from cpunet.errors import CpunetError
from cpunet.npz_files import Header
from cpunet.pulses.reading.columns import MemoryColumn, shortened
from cpunet.pulses.reading.source import Layout, PulseSource, ReadOptions, Traces

_WAVEFORMS = ("waveform", "waveforms", "values")


class ArraySource(PulseSource):
    """An array of shape ``(events, samples)``, read row by row.

    The waveforms of an ``.npz`` are ``waveform``, ``waveforms`` or ``values``, or the array
    that the option ``table`` names. Arrays with one value per event, such as ``dt_ns`` (or
    ``dt``), energies and event numbers, are columns. Pickled objects are never loaded.
    """

    def __init__(self, options: ReadOptions) -> None:
        with _readable(options.path):
            headers = npz_files.headers(options.path)
            self._key = _waveform_key(options, headers)
            header = headers[self._key]
            columns = _columns(options.path, headers)
        _require_plain(options.path, self._key, header)
        self._header = header
        super().__init__(options, Layout.of_array("NumPy", self._key, header.shape, columns))

    def _traces(self, size: int) -> Iterator[Traces]:
        row_bytes = self.length * self._header.dtype.itemsize
        with _readable(self.path), npz_files.member(self.path, self._key) as file:
            npz_files.read_header(file)
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


def _waveform_key(options: ReadOptions, headers: dict[str, Header]) -> str:
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
            "choose one with --table (--sim-table, --data-table)"
        )
    return named[0]


def _require_plain(path: Path, key: str, header: Header) -> None:
    if header.dtype.kind not in "iuf":
        raise CpunetError(
            f"{path}: array {key or 'in it'} is of {header.dtype}; save plain numbers"
        )
    if header.by_columns and min(header.shape) > 1:
        raise CpunetError(
            f"{path}: array {key or 'in it'} is stored column by column, "
            "so that no row can be read alone; save numpy.ascontiguousarray of it"
        )


def _columns(path: Path, headers: dict[str, Header]) -> dict[str, MemoryColumn]:
    """Read the arrays with one value per event, or one value, as a whole."""
    return {
        key: MemoryColumn(npz_files.read_array(path, key, header))
        for key, header in headers.items()
        if len(header.shape) <= 1 and header.dtype.kind in "iufb"
    }


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except npz_files.DAMAGED as error:
        raise CpunetError(
            f"{path}: cannot be read as NumPy file ({npz_files.said(error)}); write it again"
        ) from error
