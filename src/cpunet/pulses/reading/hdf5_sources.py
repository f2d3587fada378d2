"""Read pulses from LH5 files (LEGEND's waveform tables) and from other HDF5 files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import lh5
import numpy as np
import numpy.typing as npt
from lgdo import VectorOfVectors

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened, require_stored, text_attribute
from cpunet.pulses.reading.hdf5 import columns_of
from cpunet.pulses.reading.hdf5_tables import WaveformColumn, choose_waveforms
from cpunet.pulses.reading.lh5_rows import read_rows
from cpunet.pulses.reading.majorana import MajoranaSource, is_majorana
from cpunet.pulses.reading.source import Layout, PulseSource, ReadOptions, Traces

_PARTS = ("cumulative_length", "flattened_data")  # datasets of a vector of vectors


def open_hdf5(options: ReadOptions) -> PulseSource:
    """Open the waveforms of an HDF5 file, LH5 or not; see `opening.open_pulses`."""
    with opened(options.path) as file:
        if is_majorana(file):
            return MajoranaSource(options)
        chosen = choose_waveforms(options.path, file, options.table)
    return Lh5Source(options, chosen) if chosen.is_lh5 else Hdf5Source(options, chosen)


class Lh5Source(PulseSource):
    """An LH5 waveform table ``{t0, dt, values}``, plain or encoded, with its columns."""

    def __init__(self, options: ReadOptions, chosen: WaveformColumn) -> None:
        self._values = f"{chosen.path}/values"
        with opened(options.path) as file:
            _require_waveforms(options.path, file, self._values)
            n_pulses = lh5.read_n_rows(self._values, file) or 0
            first = self._rows(file, 0, 1, None) if n_pulses else np.empty((0, 0))
            layout = Layout(
                format="LH5",
                table=chosen.path,
                n_pulses=n_pulses,
                length=first.shape[1],
                columns=columns_of(options.path, file[chosen.table or "/"]),
                period_name=f"{chosen.path}/dt",
                period=columns_of(options.path, file[chosen.path]).get("dt"),
            )
        super().__init__(options, layout)

    def _traces(self, size: int) -> Iterator[Traces]:
        with opened(self.path) as file:
            for start in range(0, self.n_pulses or 0, size):
                yield Traces(self._rows(file, start, size, self.length))

    def _rows(
        self, file: h5py.File, start: int, size: int, length: int | None
    ) -> npt.NDArray[Any]:
        # lh5 decodes LEGEND's encoded waveforms; it reads only the requested rows.
        values = read_rows(file[self._values], start, size)
        if not isinstance(values, VectorOfVectors):
            traces = np.asarray(values.nda)
            if traces.ndim != 2 or traces.dtype.kind not in "iuf":
                raise CpunetError(
                    f"{file.filename}: {self._values} has values of {traces.dtype} and shape "
                    f"{traces.shape}; give a file of traces"
                )
            return traces
        lengths = np.diff(values.cumulative_length.nda.astype(np.int64), prepend=0)
        expected = int(lengths[0]) if length is None else length
        if (other := lengths != expected).any():
            first = int(other.argmax())
            raise CpunetError(
                f"{file.filename}: event {start + first}: {lengths[first]} samples, before it "
                f"{expected}; split the file by length"
            )
        flat = np.asarray(values.flattened_data.nda)[: lengths.sum()]
        return flat.reshape(len(lengths), expected)


def _require_waveforms(path: Path, file: h5py.File, name: str) -> None:
    """Raise a `CpunetError` unless `name` contains LH5 waveforms, all stored in the file."""
    values = file[name]
    kind = text_attribute(values, "datatype")
    if isinstance(values, h5py.Dataset):
        fits, stored = values.ndim == 2 and values.dtype.kind in "iuf", [values]
    elif "encoded" in kind:
        size, data = values.get("decoded_size"), values.get("encoded_data")
        fits, stored = is_column(size) and isinstance(data, h5py.Group), [size]
        stored += [data.get(one) for one in _PARTS] if fits else []
    else:
        fits, stored = True, [values.get(one) for one in _PARTS]
    if not fits or not all(isinstance(one, h5py.Dataset) for one in stored):
        raise CpunetError(
            f"{path}: {name} ({kind or 'of no LH5 type'}) holds no waveforms; give a file of "
            "traces"
        )
    for dataset in stored:
        require_stored(path, dataset)


class Hdf5Source(PulseSource):
    """A dataset of shape ``(events, samples)``, and the columns beside it."""

    def __init__(self, options: ReadOptions, chosen: WaveformColumn) -> None:
        self._values = chosen.path
        with opened(options.path) as file:
            dataset = file[chosen.path]
            require_stored(options.path, dataset)
            columns = columns_of(options.path, file[chosen.table or "/"])
            layout = Layout.of_array("HDF5", chosen.path, dataset.shape, columns)
        super().__init__(options, layout)

    def _traces(self, size: int) -> Iterator[Traces]:
        with opened(self.path) as file:
            dataset = file[self._values]
            for start in range(0, self.n_pulses or 0, size):
                yield Traces(dataset[start : start + size])
