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
    path, stream = options.path, _open(options.path)
    channels = [str(channel) for channel in range(int(stream.config.adcs))]
    name = options.chosen_of(channels, "channel", "channels")
    length, period_ns = int(stream.config.eventsamples), float(stream.config.sampling_period_ns)
    ahead, end, numbers = _events(path, int(name), length, stream), 0, np.empty(0, np.int64)

    def rows(start: int, stop: int) -> npt.NDArray[np.uint16]:
        nonlocal ahead, end, numbers
        if start < end:  # the stream is opened again to begin anew
            ahead = _events(path, int(name), length, _open(path))
        some = list(islice(ahead, stop - start))
        end, numbers = start + len(some), np.array([number for _, number in some], np.int64)
        return np.array([trace for trace, _ in some], np.uint16).reshape(-1, length)

    period = Column.of(np.asarray(period_ns), "ns") if period_ns > 0 else None
    return PulseSource(
        path, "FlashCam", name, None, length, rows, period_name="sampling period",
        period=period, numbers=lambda start, stop: numbers, close=stream.close,
    )  # fmt: skip


def _events(
    path: Path, channel: int, length: int, stream: FCIO
) -> Iterator[tuple[npt.NDArray[np.uint16], int]]:
    """Traces of a channel and numbers of their events, in the order of the stream.

    The last record of a truncated file looks like an event: each event is yielded only after
    the next record, or the regular end, has been read.
    """
    last: tuple[npt.NDArray[np.uint16], int] | None = None
    any_record = False
    while _next(path, stream):
        any_record = True
        if last is not None:
            yield last
        last, event = None, stream.event
        if stream.tag not in (Tags.Event, Tags.SparseEvent):
            continue
        if not (rows := np.flatnonzero(event.trace_list == channel)).size:
            continue
        number, trace = int(event.eventnumber), event.trace[rows[0]].copy()
        if len(trace) != length:
            raise CpunetError(
                f"{path}: event {number}: {len(trace)} samples, before it {length}; split the "
                "file by length"
            )
        last = trace, number
    # The library also reports an error if nothing follows the configuration, and from
    # 0.9 on none where a file is cut off.
    size = 0 if path.suffix in (".gz", ".zst") else path.stat().st_size
    if (stream.tag < 0 or stream.read_bytes() < size) and any_record:
        after = "" if last is None else f"event {last[1]}: "
        raise CpunetError(f"{path}: {after}the file is cut off; copy it again")
    if last is not None:
        yield last


def channel_sizes(path: Path) -> dict[str, int | None]:
    """Number of traces of each channel that has any; None (not counted) for a single channel.

    Raises
    ------
    CpunetError
        If the file cannot be read or is damaged.
    """
    stream, counts = _open(path), Counter[int]()
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
