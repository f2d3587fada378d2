"""Memory is asked for before it is taken, and a line says how much there is."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest

from cpunet import machine_memory, npz_files
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


def test_the_smallest_of_machine_container_and_process(tmp_path, monkeypatch, small) -> None:
    monkeypatch.setattr(machine_memory, "_GROUPS", ())
    assert available_bytes() == 1_024_000
    limit, used = tmp_path / "max", tmp_path / "current"
    monkeypatch.setattr(machine_memory, "_GROUPS", ((limit, used),))
    for told, there in (("max", 1_024_000), ("700000", 200_000), ("400000", 0)):
        limit.write_text(told)
        used.write_text("500000")
        assert available_bytes() == there
    limit.write_text("max")
    monkeypatch.setattr(resource, "getrlimit", lambda _which: (1000, 1000))
    assert available_bytes() == 0


def test_a_system_that_does_not_tell_is_trusted(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(machine_memory, "_INFO", tmp_path / "none")
    monkeypatch.setattr(machine_memory, "_GROUPS", ())
    monkeypatch.setattr(machine_memory, "_STATUS", tmp_path / "none")
    assert available_bytes() is None
    require_memory(1e30, "anything", "nothing")


def test_a_line_says_what_is_needed_and_what_there_is(small) -> None:
    require_memory(900_000, "a.lh5: 10 pulses", "give fewer")
    told = r"a.lh5: 10 pulses: about 3 GB of memory are needed, 0.001 GB are free; give fewer"
    with pytest.raises(CpunetError, match=told):
        require_memory(3e9, "a.lh5: 10 pulses", "give fewer")


def test_a_grid_and_an_array_that_do_not_fit(small, tmp_path) -> None:
    detector = read_detector("ppc")
    with pytest.raises(CpunetError, match=r"nodes: about .* GB are free; give a coarser one"):
        make_grid(detector)
    path = tmp_path / "pulses.npz"
    np.savez(path, waveform=np.zeros((400, 1000), np.float32))
    header = npz_files.headers(path)["waveform"]
    with pytest.raises(CpunetError, match=r"pulses.npz: 'waveform': about 0.0016 GB"):
        npz_files.read_array(path, "waveform", header)
