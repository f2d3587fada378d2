"""Limit the OpenBLAS threads of matrix products and decompositions in NumPy and SciPy.

OpenBLAS threads wait for each other in busy loops.  The matrices here are small: a second
thread brings no gain on idle cores.  On busy cores the other threads wait for one that has no
core; this made scores take twelve times as long.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController


@contextmanager
def one_thread_for_matrices() -> Iterator[None]:
    """Let matrix products and decompositions use one thread; also a decorator of jobs."""
    import scipy.linalg  # noqa: F401 - loads its own OpenBLAS, to be limited as well

    # OpenBLAS only: torch can have its own library, and the matrices of networks are large
    with ThreadpoolController().select(internal_api="openblas").limit(limits=1):
        yield
