"""Threads and memory of this process, for the whole program.

Both numbers that the C library is told are set each time, so that no choice of an earlier job
remains.  OpenBLAS threads wait for each other in busy loops.  The matrices here are small: a
second thread brings no gain on idle cores.  On busy cores the other threads wait for one that
has no core; this made scores take twelve times as long.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from threadpoolctl import ThreadpoolController

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # constants of glibc's malloc.h


def give_back_large_arrays() -> None:
    """Return arrays of a megabyte or more to the system when they are freed.

    For jobs that process files block by block.  By default the C library eventually keeps
    such arrays on its heap, which becomes fragmented and grows.
    """
    _choose(mmap_bytes=1 << 20, trim_bytes=1 << 17)


def keep_freed_memory() -> None:
    """Let the C library keep all freed memory.

    For trainings.  Every step of a network allocates and frees the same hundreds of megabytes.
    Fetching them from the system again takes a tenth of the step and more.
    """
    _choose(mmap_bytes=2**31 - 1, trim_bytes=2**31 - 1)


def _choose(mmap_bytes: int, trim_bytes: int) -> None:
    with suppress(OSError, AttributeError, TypeError):  # another C library
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, mmap_bytes)
        library.mallopt(_TRIM_THRESHOLD, trim_bytes)


@contextmanager
def one_thread_for_matrices() -> Iterator[None]:
    """Let matrix products and decompositions use one thread; also a decorator of jobs."""
    import scipy.linalg  # noqa: F401 - loads its own OpenBLAS, to be limited as well

    # OpenBLAS only: torch can have its own library, and the matrices of networks are large
    with ThreadpoolController().select(internal_api="openblas").limit(limits=1):
        yield
