"""Memory is asked for before it is taken, and a line says how much there is."""

from __future__ import annotations

import resource
from collections.abc import Callable
from pathlib import Path

import pytest

from cpunet import machine_memory
from cpunet.errors import CpunetError
from cpunet.machine_memory import available_bytes, require_memory
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.grid import make_grid


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A machine with 1 MB left."""
    info = tmp_path / "meminfo"
    info.write_text("MemTotal: 8000000 kB\nMemAvailable: 1000 kB\n")
    monkeypatch.setattr(machine_memory, "_INFO", info)


@pytest.fixture
def grouped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], Path]:
    """Put the process into a control group; its files are in the returned folder."""
    monkeypatch.setattr(machine_memory, "_OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(machine_memory, "_GROUPS", tmp_path / "groups")

    def put(line: str) -> Path:
        (tmp_path / "own").write_text(f"3:cpuset:/\n{line}\n")
        version_1 = "memory" if "memory" in line else ""
        folder = tmp_path / "groups" / version_1 / line.rpartition(":")[2].strip("/")
        folder.mkdir(parents=True)
        return folder

    return put


def test_the_smallest_of_machine_container_and_process(monkeypatch, small, grouped) -> None:
    folder = grouped("0::/")
    assert available_bytes() == 1_024_000
    for told, there in (("max", 1_024_000), ("700000", 200_000), ("400000", 0)):
        (folder / "memory.max").write_text(told)
        (folder / "memory.current").write_text("500000")
        assert available_bytes() == there
    (folder / "memory.max").write_text("max")
    monkeypatch.setattr(resource, "getrlimit", lambda _which: (1000, 1000))
    assert available_bytes() == 0


@pytest.mark.parametrize(
    ("line", "limit", "used"),
    [
        ("0::/job_7/step_0/task_0", "memory.max", "memory.current"),
        ("4:cpu,memory:/job_7/task_0", "memory.limit_in_bytes", "memory.usage_in_bytes"),
    ],
)
def test_the_limit_of_a_batch_job_is_that_of_a_group_further_out(
    small, grouped, line, limit, used
) -> None:
    folder = grouped(line)
    while folder.name != "job_7":
        folder = folder.parent
    (folder / limit).write_text("700000")
    (folder / used).write_text("500000")
    assert available_bytes() == 200_000


@pytest.mark.parametrize(
    "details",
    [
        "anon 100000\nactive_file 150000\ninactive_file 250000\n",
        "active_file 1\ntotal_active_file 150000\ntotal_inactive_file 250000\n",
    ],
)
def test_files_that_were_read_do_not_take_memory_away(small, grouped, details) -> None:
    """The system keeps their contents as long as nobody needs the memory."""
    folder = grouped("0::/")
    (folder / "memory.max").write_text("500000")
    (folder / "memory.current").write_text("500000")
    assert available_bytes() == 0
    (folder / "memory.stat").write_text(details)
    assert available_bytes() == 400_000


def test_a_system_that_does_not_tell_is_trusted(tmp_path, monkeypatch) -> None:
    for name in ("_INFO", "_OWN_GROUPS", "_STATUS"):
        monkeypatch.setattr(machine_memory, name, tmp_path / "none")
    assert available_bytes() is None
    require_memory(1e30, "anything", "nothing")


def test_a_line_says_what_is_needed_and_what_there_is(small) -> None:
    require_memory(900_000, "a.lh5: 10 pulses", "give fewer")
    told = r"a.lh5: 10 pulses: about 3 GB of memory are needed, 0.001 GB are free; give fewer"
    with pytest.raises(CpunetError, match=told):
        require_memory(3e9, "a.lh5: 10 pulses", "give fewer")


def test_a_grid_that_does_not_fit(small) -> None:
    detector = read_detector("ppc")
    with pytest.raises(CpunetError, match=r"nodes: about .* GB are free; give a coarser one"):
        make_grid(detector)
