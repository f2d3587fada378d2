"""Pulses of FlashCam digitiser files (``.fcio``), through the ``fcio`` library."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt
from fcio import FCIO, Tags, fcio_open

from cpunet.errors import CpunetError
from cpunet.pulses.reading.columns import Column
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import PulseSource


def read_flashcam(options: PulseFile) -> PulseSource:
    """The traces of one channel; `table` is its index if there are several.

    Full and sparse events are both read; events without the channel are skipped.
    The energy of the digitiser's own filter is not in keV and is not read.
    """
    stream = _open(options.path)
    channels = [str(channel) for channel in range(int(stream.config.adcs))]
    name = options.chosen_of(channels, "channel", "channels")
    period_ns = np.asarray(float(stream.config.sampling_period_ns))
    events = _Events(options.path, int(name), int(stream.config.eventsamples), stream)
    return PulseSource(
        path=options.path,
        format="FlashCam",
        name=name,
        n_pulses=None,
        length=events.length,
        rows=events.rows,
        numbers=events.numbers,
        close=stream.close,
        period_name="sampling period",
        period=Column.of(period_ns, "ns") if period_ns > 0 else None,
    )


class _Events:
    """Traces of a channel in the order of the stream, which is opened again to begin anew."""

    def __init__(self, path: Path, channel: int, length: int, stream: FCIO) -> None:
        self.path, self.channel, self.length = path, channel, length
        self._numbers, self._end = list[int](), 0
        self._ahead = self._iterate(stream)

    def rows(self, start: int, stop: int) -> npt.NDArray[np.uint16]:
        """Traces from a first one, which follows those read last or begins anew."""
        if start < self._end:
            self._ahead = self._iterate(_open(self.path))
        some = list(islice(self._ahead, stop - start))
        self._numbers, self._end = [number for _, number in some], start + len(some)
        return np.array([trace for trace, _ in some], np.uint16).reshape(-1, self.length)

    def numbers(self, start: int, stop: int) -> npt.NDArray[np.int64]:
        """Numbers of the events read last."""
        return np.array(self._numbers[: stop - start], np.int64)

    def _iterate(self, stream: FCIO) -> Iterator[tuple[npt.NDArray[np.uint16], int]]:
        # The last record of a truncated file looks like an event: yield each event
        # only after the next record, or the regular end, has been read.
        last: tuple[npt.NDArray[np.uint16], int] | None = None
        any_record = False
        while _next(self.path, stream):
            any_record = True
            if last is not None:
                yield last
            last, event = None, stream.event
            if stream.tag not in (Tags.Event, Tags.SparseEvent):
                continue
            rows = np.flatnonzero(event.trace_list == self.channel)
            if not rows.size:
                continue
            number, trace = int(event.eventnumber), event.trace[rows[0]].copy()
            if len(trace) != self.length:
                raise CpunetError(
                    f"{self.path}: event {number}: {len(trace)} samples, before it "
                    f"{self.length}; split the file by length"
                )
            last = trace, number
        # The library also reports an error if nothing follows the configuration, and from
        # 0.9 on none where a file is cut off.
        size = 0 if self.path.suffix in (".gz", ".zst") else self.path.stat().st_size
        if (stream.tag < 0 or stream.read_bytes() < size) and any_record:
            after = "" if last is None else f"event {last[1]}: "
            raise CpunetError(f"{self.path}: {after}the file is cut off; copy it again")
        if last is not None:
            yield last


def channel_sizes(path: Path) -> dict[str, int | None]:
    """Number of traces of each channel that has any; None (not counted) for a single channel.

    Raises
    ------
    CpunetError
        If the file cannot be read or is damaged.
    """
    counts: Counter[int] = Counter()
    stream = _open(path)
    if stream.config.adcs == 1:
        return {"0": None}
    while _next(path, stream):
        if stream.tag in (Tags.Event, Tags.SparseEvent):
            counts.update(int(channel) for channel in stream.event.trace_list)
    return {str(c): counts[c] for c in sorted(counts)}


def _next(path: Path, stream: FCIO) -> bool:
    try:
        return bool(stream.get_record())
    except Exception as error:  # the library raises various errors on damaged records
        said = " ".join(str(error).split())
        raise CpunetError(f"{path}: damaged ({said}); copy it again") from error


def _open(path: Path) -> FCIO:
    # the C library writes a harmless warning about older files
    stderr, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        stream = fcio_open(str(path))
    except Exception as error:  # the library raises various errors on damaged records
        raise CpunetError(f"{path}: cannot be read as FlashCam file; copy it again") from error
    finally:
        os.dup2(stderr, 2)
        os.close(sink)
        os.close(stderr)
    if stream.config is None:
        raise CpunetError(f"{path}: holds no configuration; copy it again")
    return stream
