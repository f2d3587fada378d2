"""One process at a time: files that are locked by the system.

The system takes a lock back however its process ends, so that none is left behind that
counts.  On file systems without locks nobody is kept out.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cpunet.errors import CpunetError


def lock(handle: int, busy: str) -> bool:
    """Lock an open file until it is closed; return whether the file system has locks.

    Parameters
    ----------
    handle
        File descriptor.
    busy
        What is said if another process holds the lock.

    Raises
    ------
    CpunetError
        If another process holds it.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise CpunetError(busy) from None
    except OSError:
        return False
    return True


@contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Hold the lock of a file, which is made if it is missing, for the block; see `lock`."""
    with path.open("a") as stream:
        lock(stream.fileno(), busy)
        yield
