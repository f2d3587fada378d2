"""Whether the HDF5 library survives the structure of a file.

On damaged files it may run for ever or crash, and neither can be caught in the process that it
happens in.  So another one, forked for it, walks through the structure first, with little
processor time; samples are not read.
"""

from __future__ import annotations

import faulthandler
import functools
import os
import resource
import signal
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py

MOST_CPU_S = 5
_MOST_OBJECTS = 20_000


def fate_of_reader(path: Path) -> str:
    """What would become of whoever looks through a file: nothing (``""``), hang or crash.

    A file is looked through once, and again if it changes.
    """
    if sys.platform != "linux":  # elsewhere a fork is not safe beside other libraries
        return ""
    try:
        facts = path.stat()
    except OSError:
        return ""
    return _fate(str(path), (facts.st_ino, facts.st_size, facts.st_mtime_ns))


@functools.lru_cache(maxsize=1024)
def _fate(path: str, _facts: tuple[int, ...]) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of threads: the child uses none of their locks
            pid = os.fork()
    except OSError:  # no memory or processes to spare
        return ""
    if pid == 0:
        _look_through_and_exit(path)
    _, status = os.waitpid(pid, 0)
    if not os.WIFSIGNALED(status):
        return ""
    hung = os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGKILL)
    return "runs for ever" if hung else "crashes"


def _look_through_and_exit(path: str) -> None:
    """In the child: end by itself, or by a signal."""
    try:
        faulthandler.disable()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGXCPU):
            signal.signal(number, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_S, MOST_CPU_S + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with h5py.File(path, "r", locking=False) as file:
            _look_through(file)
    finally:
        # whatever was raised, the reader meets it too, and can tell
        os._exit(0)


def _look_through(file: h5py.File) -> None:
    ahead: list[Any] = [file]
    seen: set[int] = set()
    while ahead and len(seen) < _MOST_OBJECTS:
        item = ahead.pop()
        with suppress(Exception):
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                continue
            seen.add(address)
        for key in _names(item.attrs):
            with suppress(Exception):
                item.attrs[key]
        if isinstance(item, h5py.Dataset):
            with suppress(Exception):
                _ = item.shape, item.dtype, item.compression, item.id.get_storage_size()
                _ = item.chunks and item.id.get_num_chunks()
        elif isinstance(item, h5py.Group):
            for key in _names(item):
                with suppress(Exception):
                    ahead.append(item.get(key))


def _names(of: Any) -> list[str]:
    with suppress(Exception):
        return list(of)
    return []
