"""File locks of the operating system, for one process at a time.

The system releases a lock however its process ends, so no stale lock remains.  File systems
without locks do not exclude anyone.
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
        Error message if another process holds the lock.

    Raises
    ------
    CpunetError
        If another process holds the lock.
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
    """Context manager that holds the lock of a file, created if missing; see `lock`."""
    with path.open("a") as stream:
        lock(stream.fileno(), busy)
        yield
