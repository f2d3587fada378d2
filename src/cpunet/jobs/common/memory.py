"""What the C library does with memory that a job has freed.

It is one setting of the whole process, so it is made here and nowhere else: by a job as it
begins, for what it does most.  Both of its numbers are set each time, so that nothing is left
of what an earlier job chose.  Without effect where the C library is not glibc.
"""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_DEFAULT_TRIM_BYTES, _LARGE_BYTES, _ANY_BYTES = 1 << 17, 1 << 20, 2**31 - 1


def give_back_large_arrays() -> None:
    """Have arrays of a megabyte and more given back to the system when freed.

    For jobs that go through files block by block.  By default the C library comes to keep
    such arrays on its heap, where holes between small pieces that stay are lost, and a
    process grows although it needs no more.
    """
    _choose(mmap_bytes=_LARGE_BYTES, trim_bytes=_DEFAULT_TRIM_BYTES)


def keep_freed_memory() -> None:
    """Let the C library keep all that is freed.

    For trainings.  A step allocates and frees the same hundreds of megabytes again and again;
    given back to the system and fetched anew, page by page, they take up to a third of it.
    """
    _choose(mmap_bytes=_ANY_BYTES, trim_bytes=_ANY_BYTES)


def _choose(mmap_bytes: int, trim_bytes: int) -> None:
    """Set from which size on memory is fetched apart, and how much may lie unused on top."""
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # as macOS and Windows say it
        return
    set_option(_MMAP_THRESHOLD, mmap_bytes)
    set_option(_TRIM_THRESHOLD, trim_bytes)
