"""Memory of a long job."""

from __future__ import annotations

import ctypes

_M_MMAP_THRESHOLD = -3  # of glibc's malloc.h
LARGE_BYTES = 1 << 20


def give_back_large_arrays() -> None:
    """Have arrays of a megabyte and more given back to the system when freed (glibc).

    By default the C library comes to keep such arrays on its heap, where holes between small
    pieces that stay are lost, and a process grows although it needs no more.  This holds for
    the rest of the process; to call it again changes nothing.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_M_MMAP_THRESHOLD, LARGE_BYTES)
