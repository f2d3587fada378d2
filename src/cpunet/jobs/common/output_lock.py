"""One process at a time writes an output."""

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
    """Hold the right to write `target`, until the block or the process ends.

    What a process that was killed has left of it is removed first.
    The lock is a hidden file beside `target`, see `cpunet.file_locks`; without locks the last
    output to be moved into place stays.

    Raises
    ------
    CpunetError
        If another process is writing it, or the folder cannot be written to.
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
            if locked:  # nobody else is at work, so these are of the dead
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
    if not same:  # its holder was done and removed it while this one was opening it
        raise CpunetError(busy)
    return True
