"""Pulses of FlashCam digitiser files (``.fcio``), through the ``fcio`` library."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from fcio import FCIO, Tags, fcio_open

from cpunet.errors import CpunetError
from cpunet.pulses.reading.energies import Column
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import Layout, PulseSource, Traces, choose_table


class FlashCamSource(PulseSource):
    """The traces of one channel; `table` is its index if there are several.

    Full and sparse events are both read; events without the channel are skipped.
    The energy of the digitiser's own filter is not in keV and is not read.
    """

    def __init__(self, options: PulseFile) -> None:
        with _opened(options.path) as stream:
            n_channels = _n_channels(options.path, stream)
            length = int(stream.config.eventsamples)
            period_ns = np.asarray(float(stream.config.sampling_period_ns))
        channels = [str(channel) for channel in range(n_channels)]
        self._channel = int(choose_table(options, channels, "channel", "channels"))
        layout = Layout(
            format="FlashCam",
            table=str(self._channel),
            n_pulses=None,
            length=length,
            period_name="sampling period",
            period=Column.of(period_ns, "ns") if period_ns > 0 else None,
        )
        super().__init__(options, layout)

    def _traces(self, size: int) -> Iterator[Traces]:
        with _opened(self.path) as stream:
            events = self._events(stream)
            while some := list(islice(events, size)):
                waveforms, numbers = zip(*some, strict=True)
                yield Traces(np.stack(waveforms), np.asarray(numbers))

    def _events(self, stream: FCIO) -> Iterator[tuple[npt.NDArray[np.uint16], int]]:
        # The last record of a truncated file looks like an event: yield each event
        # only after the next record, or the regular end, has been read.
        last: tuple[npt.NDArray[np.uint16], int] | None = None
        any_record = False
        while _next(self.path, stream):
            any_record = True
            if last is not None:
                yield last
            last = self._event(stream)
        # The library also reports an error if nothing follows the configuration, and from
        # 0.9 on none where a file is cut off.
        size = 0 if self.path.suffix in (".gz", ".zst") else self.path.stat().st_size
        if (stream.tag < 0 or stream.read_bytes() < size) and any_record:
            after = "" if last is None else f"event {last[1]}: "
            raise CpunetError(f"{self.path}: {after}the file is cut off; copy it again")
        if last is not None:
            yield last

    def _event(self, stream: FCIO) -> tuple[npt.NDArray[np.uint16], int] | None:
        if stream.tag not in (Tags.Event, Tags.SparseEvent):
            return None
        event: Any = stream.event
        rows = np.flatnonzero(event.trace_list == self._channel)
        if rows.size == 0:
            return None
        number = int(event.eventnumber)
        trace = event.trace[rows[0]].copy()
        if len(trace) != self.length:
            raise CpunetError(
                f"{self.path}: event {number}: {len(trace)} samples, before it {self.length}; "
                "split the file by length"
            )
        return trace, number


def channel_sizes(path: Path) -> dict[str, int | None]:
    """Number of traces of each channel that has any; None (not counted) for a single channel.

    Raises
    ------
    CpunetError
        If the file cannot be read or is damaged.
    """
    counts: Counter[int] = Counter()
    with _opened(path) as stream:
        n_channels = _n_channels(path, stream)
        if n_channels == 1:
            return {"0": None}
        while _next(path, stream):
            if stream.tag in (Tags.Event, Tags.SparseEvent):
                counts.update(int(channel) for channel in stream.event.trace_list)
    return {str(c): counts[c] for c in sorted(counts)}


def _n_channels(path: Path, stream: FCIO) -> int:
    if stream.config is None:
        raise CpunetError(f"{path}: holds no configuration; copy it again")
    return int(stream.config.adcs)


def _next(path: Path, stream: FCIO) -> bool:
    try:
        return bool(stream.get_record())
    except Exception as error:  # the library raises various errors on damaged records
        said = " ".join(str(error).split())
        raise CpunetError(f"{path}: damaged ({said}); copy it again") from error


@contextmanager
def _opened(path: Path) -> Iterator[FCIO]:
    try:
        with _quiet():
            stream = fcio_open(str(path))
    except Exception as error:  # the library raises various errors on damaged records
        raise CpunetError(f"{path}: cannot be read as FlashCam file; copy it again") from error
    try:
        yield stream
    finally:
        stream.close()


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide the output of the C library: a harmless warning about older files."""
    kept = os.dup(2)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(sink)
        os.close(kept)
