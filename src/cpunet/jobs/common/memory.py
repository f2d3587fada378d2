"""Settings of the C library for freed memory.

They apply to the whole process and are changed only here, by a job at its start.  Both numbers
are set each time, so that no choice of an earlier job remains.  They have no effect if the C
library is not glibc.
"""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # constants of glibc's malloc.h
_DEFAULT_TRIM_BYTES, _LARGE_BYTES, _ANY_BYTES = 1 << 17, 1 << 20, 2**31 - 1


def give_back_large_arrays() -> None:
    """Return arrays of a megabyte or more to the system when they are freed.

    For jobs that process files block by block.  By default the C library eventually keeps
    such arrays on its heap.  The heap becomes fragmented, and the process grows although it
    does not need more memory.
    """
    _choose(mmap_bytes=_LARGE_BYTES, trim_bytes=_DEFAULT_TRIM_BYTES)


def keep_freed_memory() -> None:
    """Let the C library keep all freed memory.

    For trainings.  Every step allocates and frees the same hundreds of megabytes.  Returning
    them to the system and fetching them again takes up to a third of the step.
    """
    _choose(mmap_bytes=_ANY_BYTES, trim_bytes=_ANY_BYTES)


def _choose(mmap_bytes: int, trim_bytes: int) -> None:
    """Set the size from which memory is mapped separately, and the maximum unused heap top."""
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # raised on macOS and Windows
        return
    set_option(_MMAP_THRESHOLD, mmap_bytes)
    set_option(_TRIM_THRESHOLD, trim_bytes)
