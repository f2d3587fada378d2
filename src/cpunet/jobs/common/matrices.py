"""Threads of matrix products and decompositions, which NumPy and SciPy leave to OpenBLAS.

Its threads wait for each other in busy loops.  Ours are small matrices, for which a second
thread brings nothing on a free machine; where something else runs, too, the thread that is
waited for has no core, and scores took twelve times as long.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController


@contextmanager
def one_thread_for_matrices() -> Iterator[None]:
    """Let matrix products and decompositions use one thread; also a decorator of jobs."""
    import scipy.linalg  # noqa: F401 - brings an OpenBLAS of its own, which is to be limited

    # other libraries may be torch's own, whose products of a network are large
    with ThreadpoolController().select(internal_api="openblas").limit(limits=1):
        yield
