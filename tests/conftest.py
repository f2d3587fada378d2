"""What several test modules share."""

from __future__ import annotations

import gc
import os
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# torch and cpunet are imported where they are used: the process that only hands out tests
# begins sooner without them

# compilation and a shared machine make single examples slow now and then
settings.register_profile("cpunet", deadline=None, max_examples=25)
settings.register_profile("full", deadline=None, max_examples=200)  # see `make test-slow`
settings.load_profile("cpunet")

BEGUN = time.monotonic()
gc.disable()  # until all tests are imported: a fifth of the time that it takes


def pytest_configure() -> None:
    """Have processes that are started use one thread.

    The last bits of a training depend on the number of threads, and a server that processes
    are forked from keeps that of the first test that needs it.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # freed arrays stay with a process: to be given new pages each time takes a tenth longer
    os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(32 << 20))
    os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", str(1 << 30))


def pytest_collection_finish() -> None:
    """Leave what all tests keep, imported modules and tests, to no search for garbage."""
    gc.collect()
    gc.freeze()
    gc.enable()
    gc.set_threshold(10_000)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip slow tests when the time for them is over: on a slow machine some are left out."""
    minutes = float(os.environ.get("CPUNET_SLOW_MINUTES", "inf"))
    if item.get_closest_marker("slow") and time.monotonic() - BEGUN > 60 * minutes:
        pytest.skip(f"the {minutes:g} minutes for slow tests are over")


@pytest.fixture(autouse=True, scope="session")
def every_error_is_one_line() -> Iterator[None]:
    """Of all that any test provokes."""
    from cpunet.errors import CpunetError

    begin = CpunetError.__init__

    def checked(error: CpunetError, *given: Any, **options: Any) -> None:
        begin(error, *given, **options)
        assert "\n" not in str(error), error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CpunetError, "__init__", checked)
        yield


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[float | None]]:
    """Total and steps of each stage of the work, by title."""
    from cpunet import progress

    seen: dict[str, list[float | None]] = {}

    def update(bar: progress.Stage, n: float = 1) -> None:
        seen.setdefault(bar.desc, [bar.total]).append(n)

    monkeypatch.setattr(progress.Stage, "update", update)
    return seen


@pytest.fixture(scope="module")
def reads() -> Iterator[Counter[Path]]:
    """How often the pulses of each file have been read by the tests of a module."""
    from cpunet.pulses.reading.source import PulseSource

    times, blocks = Counter[Path](), PulseSource.blocks

    def counted(source: PulseSource, size: int = 4096) -> Iterator[Any]:
        times[source.path] += 1
        return blocks(source, size)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PulseSource, "blocks", counted)
        yield times


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the figures of reports empty: to draw them takes most of a small report's time."""
    from synthetic import leave_undrawn

    leave_undrawn(monkeypatch)


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Folder of the optional reference data; the test skips without it."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("CPUNET_REFERENCE_DATA", default))
    if not folder.is_dir():
        pytest.skip("no reference data: set CPUNET_REFERENCE_DATA to their folder")
    return folder


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep solved fields with the other files of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CPUNET_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
        yield


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Tiny networks: threads that wait for each other cost more than they gain."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def one_thread_again() -> Iterator[None]:
    """What a test sets must not reach the next one: the last bits depend on it."""
    yield
    import torch

    torch.set_num_threads(1)
