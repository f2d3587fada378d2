"""Files that a library hangs or crashes on are met in a process of their own."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest

from cpunet import file_probe
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened

pytestmark = [
    pytest.mark.probed,
    pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux only"),
]


def hang(_of: object) -> None:
    while True:
        pass


def crash(_of: object) -> None:
    os.abort()


@pytest.mark.parametrize(("look", "told"), [(hang, "runs for ever"), (crash, "crashes")])
def test_what_would_hang_or_crash_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, look: Callable[[object], None], told: str
) -> None:
    path = tmp_path / "damaged.lh5"
    h5py.File(path, "w").close()
    monkeypatch.setattr(file_probe, "_look_through", look)
    monkeypatch.setattr(file_probe, "MAX_CPU_S", 1)
    message = rf"damaged.lh5: is damaged \(the HDF5 library {told} on it\); copy or"
    with pytest.raises(CpunetError, match=message), opened(path):
        pass


def test_a_process_that_waits_for_ever_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for a lock that a thread held when it was forked: nothing is learned of the file."""
    path = tmp_path / "whole.lh5"
    h5py.File(path, "w").close()
    monkeypatch.setattr(file_probe, "_look_through", lambda _of: signal.pause())
    monkeypatch.setattr(file_probe, "MAX_WAIT_S", 0.1)
    with opened(path) as file:
        assert not list(file)


def test_killed_by_the_system_says_nothing_about_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for lack of memory."""
    path = tmp_path / "whole.lh5"
    h5py.File(path, "w").close()
    monkeypatch.setattr(
        file_probe, "_look_through", lambda _of: os.kill(os.getpid(), signal.SIGKILL)
    )
    with opened(path) as file:
        assert not list(file)


def test_where_ended_processes_leave_no_status_nothing_is_learned(tmp_path: Path) -> None:
    """A program inherits it from its parent that SIGCHLD is ignored."""
    path = tmp_path / "whole.lh5"
    h5py.File(path, "w").close()
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        with opened(path) as file:
            assert not list(file)
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_a_file_is_looked_through_again_if_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, forks = tmp_path / "whole.lh5", list[int]()
    fork = os.fork

    def counted() -> int:
        forks.append(1)
        return fork()

    monkeypatch.setattr("os.fork", counted)
    for name in "ab":
        with h5py.File(path, "a") as file:
            file[name] = list(range(1000))
        for _ in range(3):
            with opened(path) as file:
                assert name in file
    assert len(forks) == 2
