"""What several test modules share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# compilation and a shared machine make single examples slow now and then
settings.register_profile("cpunet", deadline=None)
settings.load_profile("cpunet")


def pytest_configure() -> None:
    """Give each process its own compiled code, and those that it starts one thread.

    Two that write the same cache at once, as in a fresh checkout, may read what the other has
    half written, and crash.  The last bits of a training depend on the number of threads, and
    a server that processes are forked from keeps that of the first test that needs it.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if worker := os.environ.get("PYTEST_XDIST_WORKER"):
        caches = Path(__file__).resolve().parents[1] / ".pytest_cache" / "numba"
        os.environ.setdefault("NUMBA_CACHE_DIR", str(caches / worker))


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Folder of the optional reference data; the test skips without it."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("CPUNET_REFERENCE_DATA", default))
    if not folder.is_dir():
        pytest.skip("no reference data: set CPUNET_REFERENCE_DATA to their folder")
    return folder


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Tiny networks: threads that wait for each other cost more than they gain."""
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def one_thread_again() -> Iterator[None]:
    """What a test sets must not reach the next one: the last bits depend on it."""
    yield
    torch.set_num_threads(1)
