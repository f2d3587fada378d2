"""Check that the libraries of HDF5 and FlashCam can read a file.

On damaged files they can hang or crash, and neither can be handled in the same process.  A
forked process therefore scans the file first, with limits on processor time and memory: the
structure of HDF5 files without samples, and the first records of FlashCam files.
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
from typing import Any, Literal

import h5py

from cpunet.errors import CpunetError

Kind = Literal["HDF5", "FlashCam"]

MAX_CPU_S = 5
# The forked process can deadlock on a lock that a thread of this one held at the fork.
MAX_WAIT_S = 60.0
_FAILS = "fails"
MAX_BYTES = 1 << 30
_MAX_RECORDS = 1000
_MAX_OBJECTS = 20_000


def require_survivable(path: Path, kind: Kind = "HDF5") -> None:
    """Raise a `CpunetError` if reading a file would hang or crash.

    A file is scanned once, and again if it changes.
    """
    if sys.platform != "linux":  # on other systems a fork is unsafe with other libraries
        return
    try:
        facts = path.stat()
    except OSError:
        return
    fate = _fate(str(path), kind, (facts.st_ino, facts.st_size, facts.st_mtime_ns))
    if fate == _FAILS:
        raise CpunetError(f"{path}: cannot be read as {kind} file; copy it again")
    if fate:
        raise CpunetError(
            f"{path}: is damaged (the {kind} library {fate} on it); copy or write it again"
        )


@functools.lru_cache(maxsize=1024)
def _fate(path: str, kind: Kind, _facts: tuple[int, ...]) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about threads: the child uses none of their locks
            pid = os.fork()
    except OSError:  # out of memory or processes
        return ""
    if pid == 0:
        _look_through_and_exit(path, kind)
    try:
        _, status = os.waitpid(pid, 0)
    except ChildProcessError:  # SIGCHLD is ignored, so the system does not keep the status
        return ""
    if not os.WIFSIGNALED(status):
        return "" if os.waitstatus_to_exitcode(status) == 0 else _FAILS
    if os.WTERMSIG(status) == signal.SIGALRM:  # timed out without a result for the file
        return ""
    if os.WTERMSIG(status) == signal.SIGKILL:  # by the system, as for lack of memory
        return ""
    return "runs for ever" if os.WTERMSIG(status) == signal.SIGXCPU else "crashes"


def _look_through_and_exit(path: str, kind: Kind) -> None:
    """Scan the file in the child, and exit; a hang or crash ends the child by a signal."""
    # for FlashCam an exception means failure: where it is lack of memory, the reader would
    # exhaust the memory
    ended = 0 if kind == "HDF5" else 1
    try:
        faulthandler.disable()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGXCPU, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, ())
        signal.setitimer(signal.ITIMER_REAL, MAX_WAIT_S)
        resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        most = in_use + MAX_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        if kind == "HDF5":
            with h5py.File(path, "r", locking=False) as file:
                _look_through(file)
        else:
            _look_at_records(path)
            ended = 0
    finally:
        # the reader meets the same exception and reports it
        os._exit(ended)


def _look_through(file: h5py.File) -> None:
    ahead: list[Any] = [file]
    seen: set[int] = set()
    while ahead and len(seen) < _MAX_OBJECTS:
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


def _look_at_records(path: str) -> None:
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 2)  # silences the messages of the library
    from fcio import fcio_open

    stream = fcio_open(path)
    for _ in range(_MAX_RECORDS):
        if not stream.get_record():
            break


def _names(of: Any) -> list[str]:
    with suppress(Exception):
        return list(of)
    return []
