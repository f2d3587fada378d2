"""The C library's memory, as it tells of it itself, in processes of their own."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest

glibc = pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="the C library tells nothing of itself"
)
# Allocates 16 MB in one piece and 64 MB in many, frees them, and prints how many bytes lay
# apart from the heap, and how many stay on top of it.
SCRIPT = """
import ctypes
from cpunet.jobs.common.memory import give_back_large_arrays, keep_freed_memory
{jobs}
library = ctypes.CDLL(None)
names = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"
class Told(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in names.split()]
library.mallinfo2.restype = Told
library.malloc.restype = ctypes.c_void_p
library.malloc.argtypes = [ctypes.c_size_t]
library.free.argtypes = [ctypes.c_void_p]
before = library.mallinfo2().hblkhd
large = library.malloc(16 << 20)
apart = library.mallinfo2().hblkhd - before
library.free(large)
fill = [library.malloc(64 << 10) for _ in range(1024)]  # what was free in the heap is not now
for piece in [library.malloc(64 << 10) for _ in range(1024)]:
    library.free(piece)
print(apart, library.mallinfo2().keepcost)
"""


def told(*jobs: str) -> tuple[int, int]:
    """Bytes apart from the heap, and kept on it, after jobs of a process began."""
    script = SCRIPT.format(jobs="\n".join(f"{job}()" for job in jobs))
    run = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    apart, kept = map(int, run.stdout.split())
    return apart, kept


@glibc
@pytest.mark.parametrize("before", [(), ("keep_freed_memory",)])
def test_a_translation_gives_memory_back_whatever_ran_before(before: tuple[str, ...]) -> None:
    apart, kept = told(*before, "give_back_large_arrays")
    assert apart >= 16 << 20
    assert kept < 1 << 20


@glibc
@pytest.mark.parametrize("before", [(), ("give_back_large_arrays",)])
def test_a_training_keeps_memory_whatever_ran_before(before: tuple[str, ...]) -> None:
    apart, kept = told(*before, "keep_freed_memory")
    assert apart == 0
    assert kept >= 64 << 20
