"""The Majorana Demonstrator's data release for AI and machine learning (HDF5).

The layout is that of Table I of the release's notes (arXiv:2308.10856; the files are
10.5281/zenodo.8257027): datasets at the top of the file, one row per event, named
``raw_waveform`` (3,800 samples), ``energy_label`` (keV), ``psd_label_low_avse``,
``psd_label_high_avse``, ``psd_label_dcr``, ``psd_label_lq`` (1: passes the cut), ``tp0``,
``detector``, ``run_number`` and ``id``.  The NPML files have neither energies nor cuts.
Neither the notes' table nor the files give the sampling period.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened
from cpunet.pulses.reading.energies import MemoryColumn
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import Layout, PulseSource, Traces
from cpunet.tables import shortened

WAVEFORMS, DETECTOR = "raw_waveform", "detector"
_NUMBERS = (DETECTOR, "run_number", "id")  # beside the waveforms, in every file
_RENAMED = {"energy_label": ("energy", "keV"), "id": ("event_number", "")}
_PERIOD_HINT = "the Majorana Demonstrator's digitisers ran at 100 MHz: 10"
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
                period_hint=_PERIOD_HINT,
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
    known = detectors(file)
    if options.table is None:
        if len(known) > 1:
            raise CpunetError(
                f"{options.path}: {len(known)} detectors ({shortened(known)}); choose one with "
                f"`table`, or all with `table` {WAVEFORMS}"
            )
        return np.arange(n)
    if options.table not in known:
        raise CpunetError(
            f"{options.path}: no detector {options.table}; there are {shortened(known)}"
        )
    return np.flatnonzero(file[DETECTOR][()].astype(str) == options.table)


def _columns(file: h5py.File) -> Iterator[tuple[str, npt.NDArray[np.generic], str]]:
    """Yield name, values and units of each column beside the traces (a few bytes per event)."""
    for name in file:
        column = file.get(name)
        if not is_column(column) or column.ndim == 0:
            continue
        shown, units = _RENAMED.get(name, (name, ""))
        yield shown, np.asarray(column[()]), units
