"""Files of several channels: one run, one report and one file of translations for each."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.channels import channel_names, channels_of, each_channel, paired
from cpunet.pulses.reading.files import PulseFile

log = logging.getLogger("cpunet.pulses")


@pytest.fixture
def raw(stand, tmp_path: Path) -> Path:
    """Two channels with the stand's traces, and one without pulses that can be used."""
    file = tmp_path / "raw.lh5"
    with h5py.File(stand.data) as source, h5py.File(file, "w") as target:
        for channel in ("ch1", "ch2", "ch3"):
            source.copy("geds/raw", target.create_group(channel), "raw")
            target[channel].attrs["datatype"] = "struct{raw}"
        target["ch3/raw/energy"][...] = 100.0
    return file


@pytest.mark.thorough
def test_train_validate_and_translate_all(command, stand, raw, tiny, tmp_path, undrawn):
    files = ["--sim", stand.sim, "--data", raw, "--data-table", "all"]
    trained = command("train", *files, "--out", tmp_path / "runs", *tiny)
    assert trained.code == 1
    begins = ["ch1  Run ", "ch2  Run ", "ch3  failed: "]
    for line, begin in zip(trained.out.splitlines()[:3], begins, strict=True):
        assert line.startswith(begin)
    info = json.loads((tmp_path / "runs" / "ch2" / "run.json").read_text())
    assert info["data"]["read_as"] == {"table": "ch2/raw"}

    words = [*files, "--no-baselines", "--out", tmp_path / "reports"]
    validated = command("validate", tmp_path / "runs", *words)
    assert validated.code == 1
    lines = [line.split()[0] for line in validated.out.splitlines()]
    assert lines == ["ch1", "ch2", "ch3"]
    assert "scores off" in validated.out
    assert (tmp_path / "reports" / "ch1" / "report.html").is_file()
    index = (tmp_path / "reports" / "index.html").read_text("utf-8")
    assert 'href="ch2/report.html"' in index
    assert "ch3" in index

    # a report of before is not shown for a channel that fails now
    with h5py.File(raw, "a") as file:
        file["ch2/raw/energy"][...] = 100.0
    again = command("validate", tmp_path / "runs", *words)
    assert "ch1: exists already" in again.out.replace(str(tmp_path / "reports") + "/", "")
    again = command("validate", tmp_path / "runs", *words, "--force")
    assert again.out.count("failed: ") == 2
    index = (tmp_path / "reports" / "index.html").read_text("utf-8")
    assert 'href="ch1/report.html"' in index
    assert 'href="ch2/report.html"' not in index
    assert (tmp_path / "reports" / "ch2" / "report.html").is_file()
    with h5py.File(raw, "a") as file, h5py.File(stand.data) as source:
        file["ch2/raw/energy"][...] = source["geds/raw/energy"][...]

    out = tmp_path / "translated"
    words = ["--table", "all", "--inverse", "--out", out]
    translated = command("translate", tmp_path / "runs", raw, *words)
    assert translated.code == 1
    assert translated.out.startswith("ch1  ")
    assert len(lh5.read("geds/iren/energy", out / "ch2.lh5")) == len(stand.data_kev)

    # one simulation serves all channels
    both = tmp_path / "both"
    single = command("translate", tmp_path / "runs", stand.sim, "--table", "all", "--out", both)
    assert single.code == 0, single.err
    assert sorted(file.name for file in both.glob("*.lh5")) == ["ch1.lh5", "ch2.lh5"]

    # every option reaches the channels
    piled = [*words[:3], "--pile-up-khz", 1, "--out", tmp_path / "piled"]
    refused = command("translate", tmp_path / "runs", raw, *piled)
    assert "leave out --pile-up-khz" in refused.out + refused.err

    again = command("train", *files, "--out", tmp_path / "runs", *tiny, "--resume")
    assert again.code == 1
    assert "ch1: trained already" in again.err


def test_check_looks_at_each_channel(command, stand, raw, tmp_path):
    files = ["--sim", stand.sim, "--data", raw, "--data-table", "all"]
    told = command("check", *files, "--out", tmp_path / "check.png")
    assert told.code == 1  # for the channel without pulses of the line
    channels = [line for line in told.out.splitlines() if line.endswith(":")]
    assert channels == ["ch1:", "ch2:", "ch3:"]
    assert told.out.partition("ch3:")[2].startswith("\nstop ")
    pictures = sorted(path.name for path in tmp_path.glob("*.png"))
    assert pictures[:2] == ["check-ch1.png", "check-ch2.png"]


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


@pytest.mark.parametrize("cores", ["1", pytest.param("2", marks=pytest.mark.thorough)])
def test_one_that_fails_is_counted_and_the_others_go_on(tmp_path, caplog, monkeypatch, cores):
    caplog.set_level("INFO", "cpunet")
    data = PulseFile(made(tmp_path / "raw.h5", "ch1/raw", "ch2/raw", "ch3/raw"), "all")

    monkeypatch.setenv("OMP_NUM_THREADS", cores)
    outcome = each_channel(paired(data, data), tmp_path / "out", work)
    assert [*outcome.done.items()] == [("ch1", "ch1"), ("ch3", "ch3")]
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
