"""Channels of a file, each on its own."""

from __future__ import annotations

import logging
from pathlib import Path

import h5py
import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.channels import (
    channel_names,
    channels_of,
    each_channel,
    paired,
)
from cpunet.pulses.reading.files import PulseFile

log = logging.getLogger("cpunet.pulses")


def made(path: Path, *tables: str) -> Path:
    with h5py.File(path, "w") as file:
        for table in tables:
            file.create_group(table)["waveform"] = np.zeros((3, 50), np.float32)
    return path


def test_channels_have_short_names_and_their_own_energies(tmp_path):
    raw = made(tmp_path / "raw.h5", "ch1/raw", "ch2/raw")
    file = PulseFile(raw, "all", "hit.lh5:{channel}/hit/energy")
    found = channels_of(file)
    assert [(n, f.table, f.energy) for n, f in found.items()] == [
        ("ch1", "ch1/raw", "hit.lh5:ch1/hit/energy"),
        ("ch2", "ch2/raw", "hit.lh5:ch2/hit/energy"),
    ]
    with pytest.raises(CpunetError, match="one column for 2 channels"):
        channels_of(PulseFile(raw, "all", "hit.lh5:energy"))
    np.save(tmp_path / "raw.npy", np.zeros((3, 50)))
    with pytest.raises(CpunetError, match="no tables of waveforms"):
        channels_of(PulseFile(tmp_path / "raw.npy", "all"))


def test_no_channel_is_lost_whose_name_looks_like_another():
    tables = ["a b/raw", "a_b/raw", "a/b/raw", "ch1/raw", ""]
    names = channel_names(tables)
    assert list(names.values()) == tables
    assert all(name and not set(name) & set("/ ") for name in names)
    assert channel_names([""]) == {"root": ""}


def test_a_simulation_serves_all_channels_or_its_own(tmp_path):
    data = PulseFile(made(tmp_path / "raw.h5", "ch1/raw", "ch2/raw"), "all")
    one = PulseFile(made(tmp_path / "one.h5", "geds/sim"))
    assert [pair[0] for pair in paired(one, data).values()] == [one, one]
    both = PulseFile(made(tmp_path / "both.h5", "ch1/sim", "ch3/sim"), "all")
    found = paired(both, data)
    assert found["ch1"][0].table == "ch1/sim"
    assert str(found["ch2"]).endswith("both.h5: no table of ch2; there are those of ch1, ch3")
    files = paired(PulseFile(tmp_path / "{channel}" / "sim.h5"), data)
    assert [pair[0].path.parent.name for pair in files.values()] == ["ch1", "ch2"]


def work(name: str, _pair: object, out: Path) -> str:
    if name == "ch2":
        raise CpunetError("too few pulses")
    log.warning("a doubt")
    return out.name


@pytest.mark.parametrize("cores", ["1", "2"])
def test_one_that_fails_is_counted_and_the_others_go_on(tmp_path, caplog, monkeypatch, cores):
    caplog.set_level("INFO", "cpunet")
    data = PulseFile(made(tmp_path / "raw.h5", "ch1/raw", "ch2/raw", "ch3/raw"), "all")

    monkeypatch.setenv("OMP_NUM_THREADS", cores)
    outcome = each_channel(paired(data, data), tmp_path / "out", work)
    assert list(outcome.done) == ["ch1", "ch3"]
    assert outcome.done == {"ch1": "ch1", "ch3": "ch3"}
    assert outcome.failed == {"ch2": "too few pulses"}
    assert "ch2: failed: too few pulses" in caplog.messages
    for name in ("ch1", "ch3"):  # each has its own messages
        assert caplog.messages[caplog.messages.index(f"{name}:") + 1] == "a doubt"
    assert not outcome.ok
    assert str(outcome) == "ch1  ch1\nch3  ch3\nch2  failed: too few pulses"


def test_an_output_of_one_is_refused(tmp_path):
    data = PulseFile(made(tmp_path / "raw.h5", "ch1/raw", "ch2/raw"), "all")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".cpunet.json").write_text("{}")
    with pytest.raises(CpunetError, match="is the output of one channel"):
        each_channel(paired(data, data), tmp_path / "run", lambda *_: None)
