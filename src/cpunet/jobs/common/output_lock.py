"""A lock that lets one process at a time write an output."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cpunet.errors import CpunetError
from cpunet.file_locks import lock
from cpunet.files import remove_partial


@contextmanager
def only_writer(target: Path) -> Iterator[None]:
    """Hold the lock of `target` until the block or the process ends.

    Temporary files of killed processes are removed first.
    The lock is a hidden file beside `target`, see `cpunet.file_locks`.  On file systems without
    locks, the last output to be moved into place wins.

    Raises
    ------
    CpunetError
        If another process is writing `target`, or the folder is not writable.
    """
    path = target.parent / f".{target.name}.lock"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise CpunetError(f"{target}: cannot be written ({error.strerror})") from error
    try:
        locked = _lock(handle, path, target)
        try:
            if locked:  # no other process is writing, so these belong to killed ones
                remove_partial(target)
            yield
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _lock(handle: int, path: Path, target: Path) -> bool:
    """Lock the file; return whether the file system has locks."""
    busy = f"{target}: another process is writing it; wait for that one"
    if not lock(handle, busy):
        return False
    try:
        same = os.fstat(handle).st_ino == path.stat().st_ino
    except FileNotFoundError:
        same = False
    if not same:  # its holder finished and removed it while this process opened it
        raise CpunetError(busy)
    return True
