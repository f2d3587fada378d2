"""Tables that hold several channels, and files whose tables and columns are links."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from lh5.compression import ULEB128ZigZagDiff

from cpunet.errors import CpunetError
from cpunet.pulses.channels import channels_of
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.reading.files import PulseFile, table_sizes
from cpunet.pulses.writing import other_columns
from synthetic import one_line, waveform_table, write_table

N, LENGTH = 12, 40
RAW = np.random.default_rng(1).integers(0, 60000, (N, LENGTH), dtype=np.uint16)
KEV = np.linspace(100, 2000, N)
HALF, PAIRS = np.tile([3, 7], N // 2), np.repeat([0, 1], N // 2)
BROKEN = {
    "other file": h5py.ExternalLink("none.lh5", "ch/raw"),
    "other table": h5py.ExternalLink("two.lh5", "none"),
    "soft": h5py.SoftLink("/none"),
    "loop": h5py.SoftLink("/raw/loop"),
}
COMPOUND = np.zeros(N, [("energy", "f8"), ("waveform", "u2", (LENGTH,))])


def write(path: Path, table: str = "raw", traces=RAW, kev=KEV, **columns) -> Path:
    return write_table(path, table, traces, kev, **columns)


@pytest.mark.parametrize(
    ("columns", "chosen", "rows"),
    [
        ({"channel": HALF}, "channel=7", HALF == 7),
        ({"fch_id": HALF.astype("u2")}, "fch_id=3", HALF == 3),
        ({"chnid": HALF.astype(float)}, "chnid=7", HALF == 7),
        ({"chnid": PAIRS}, "chnid=1", PAIRS == 1),
        ({"det_uid": HALF, "card": 0 * HALF}, "det_uid=7", HALF == 7),
        ({"card": PAIRS, "channel": HALF}, "card=1,channel=3", (HALF == 3) & (PAIRS == 1)),
        ({"rawid": 10 * PAIRS + HALF, "slot": PAIRS}, "rawid=13", (HALF == 3) & (PAIRS == 1)),
    ],
)
def test_rows_of_one_channel_are_chosen(tmp_path, columns, chosen, rows):
    path = write(tmp_path / "raw.lh5", **columns, baseline=np.arange(N))
    one_line(lambda: open_pulses(path), "channels or detectors", chosen.split(",")[0][:3])
    assert f"raw/{chosen}" in table_sizes(path)
    for table in (f"raw/{chosen}", chosen):
        source = open_pulses(path, table=table)
        pulses = source.read()
        np.testing.assert_array_equal(pulses.waveforms, RAW[rows])
        np.testing.assert_array_equal(pulses.energy_kev, KEV[rows])
    in_twos = Pulses.concatenate(list(source.blocks(2)))
    np.testing.assert_array_equal(in_twos.waveforms, RAW[rows])
    np.testing.assert_array_equal(in_twos.energy_kev, KEV[rows])
    read, left_out = other_columns(source, ["waveform", "energy"])
    assert not left_out
    np.testing.assert_array_equal(read(1, 2)["baseline"].nda, np.flatnonzero(rows)[1:3])
    any_of = ",".join(f"{name}=*" for name in columns)
    assert open_pulses(path, table=any_of).n_pulses == N
    with pytest.raises(CpunetError, match=r"no channel 4; it holds 3, 7|no column channel"):
        open_pulses(path, table="channel=4")


@pytest.mark.parametrize("name", ["energy_bin", "epoch", "batch"])
def test_other_columns_of_few_values_do_not_part_rows(tmp_path, name):
    assert open_pulses(write(tmp_path / "raw.lh5", **{name: HALF})).n_pulses == N


def test_channels_that_are_text_and_arrays_of_numpy(tmp_path):
    names = np.array([b"V01", b"V02"])[PAIRS]
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file["waveform"], file["dt_ns"], file["detector"] = RAW, 16.0, names
    assert [*table_sizes(tmp_path / "raw.h5")] == ["detector=V01", "detector=V02"]
    assert open_pulses(tmp_path / "raw.h5", table="detector=V02").n_pulses == N // 2
    np.savez(tmp_path / "raw.npz", waveform=RAW, dt_ns=16.0, ch=HALF)
    one_line(lambda: open_pulses(tmp_path / "raw.npz"), "`table` ch=3")
    found = open_pulses(tmp_path / "raw.npz", table="ch=7").read()
    np.testing.assert_array_equal(found.waveforms, RAW[HALF == 7])


def test_compressed_traces_of_one_channel(tmp_path):
    values = waveform_table(RAW)
    values["values"].attrs["compression"] = ULEB128ZigZagDiff()
    path = write_table(tmp_path / "raw.lh5", "raw", values, channel=HALF)
    for table, rows in (("raw/channel=*", slice(None)), ("channel=3", HALF == 3)):
        found = Pulses.concatenate(list(open_pulses(path, table=table).blocks(5)))
        np.testing.assert_array_equal(found.waveforms, RAW[rows])


@pytest.mark.parametrize("whole", [True, False])
def test_energies_of_another_file_are_those_of_the_channel(tmp_path, whole):
    path = write(tmp_path / "raw.lh5", channel=HALF, eventnumber=np.arange(N) // 2)
    rows = slice(None) if whole else HALF == 7
    hits = {"E_cal": KEV[rows] + 1, "eventnumber": (np.arange(N) // 2)[rows]}
    energy = f"{write_table(tmp_path / 'hit.lh5', 'hit', **hits)}:hit/E_cal"
    assert list(channels_of(PulseFile(path, "all", energy))) == ["channel_3", "channel_7"]
    source = open_pulses(path, table="channel=7", energy=energy)
    np.testing.assert_array_equal(source.read().energy_kev, KEV[HALF == 7] + 1)


def linked(folder: Path, kind: str, inner: str) -> Path:
    """Two channels as links to tables of one name in two files, or in folders of one."""
    master = folder / "master.h5"
    for number, name in enumerate(("one", "two")):
        of = folder / f"{name}.lh5" if kind == "external" else master
        table = inner if kind == "external" else f"{name}/{inner}"
        write(of, table, RAW + number, KEV + number)
    with h5py.File(master, "a") as file:
        for channel, name in (("ch1", "one"), ("ch2", "two")):
            external = h5py.ExternalLink(f"{name}.lh5", inner)
            soft = h5py.SoftLink(f"/{name}/{inner}")
            file[f"{channel}/raw"] = external if kind == "external" else soft
    return master


@pytest.mark.parametrize("kind", ["external", "soft"])
@pytest.mark.parametrize("inner", ["ch1/raw", "geds"])
def test_each_link_reads_its_own_table(tmp_path, kind, inner):
    master = linked(tmp_path, kind, inner)
    if kind == "external":
        assert [*table_sizes(master)] == ["ch1/raw", "ch2/raw"]
    for number, channel in enumerate(("ch1", "ch2")):
        source = open_pulses(master, table=f"{channel}/raw")
        np.testing.assert_array_equal(source.read().waveforms, RAW + number)
        np.testing.assert_array_equal(source.read().energy_kev, KEV + number)
        energy = f"{master}:{channel}/raw/energy"
        same = open_pulses(master, table="ch1/raw", energy=energy).read()
        np.testing.assert_array_equal(same.energy_kev, KEV + number)


@pytest.mark.parametrize("part", ["energy", "waveform/values"])
def test_columns_that_are_links_to_other_files(tmp_path, part):
    write(tmp_path / "one.lh5"), write(tmp_path / "two.lh5", traces=RAW + 1, kev=KEV + 1)
    with h5py.File(tmp_path / "one.lh5", "a") as file:
        del file[f"raw/{part}"]
        file[f"raw/{part}"] = h5py.ExternalLink("two.lh5", f"raw/{part}")
    pulses = open_pulses(tmp_path / "one.lh5").read()
    np.testing.assert_array_equal(pulses.waveforms, RAW + (part != "energy"))
    np.testing.assert_array_equal(pulses.energy_kev, KEV + (part == "energy"))


@pytest.mark.parametrize("kind", BROKEN)
@pytest.mark.parametrize("place", ["ch2", "ch2/raw", "raw/energy"])
def test_a_broken_link_is_named_with_its_target(tmp_path, kind, place):
    write(tmp_path / "two.lh5"), write(tmp_path / "one.lh5")
    with h5py.File(tmp_path / "one.lh5", "a") as file:
        if place in file:
            del file[place]
        file[place] = BROKEN[kind]
        file["raw/loop"] = h5py.SoftLink("/raw/loop") if kind == "loop" else 1
    said = ["is a link to", BROKEN[kind].path, place.rpartition("/")[2]]
    one_line(lambda: open_pulses(tmp_path / "one.lh5"), *said)
    table = "raw" if place.startswith("raw") else place
    assert table in table_sizes(tmp_path / "one.lh5")
    one_line(lambda: open_pulses(tmp_path / "one.lh5", table=table), *said)
    if kind != "loop":
        energy = f"{tmp_path}/one.lh5:{place}/energy".replace("energy/energy", "energy")
        one_line(lambda: open_pulses(tmp_path / "two.lh5", energy=energy), *said)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (COMPOUND, "(12,) of [('energy', '<f8'), ('waveform', '<u2', (40,))]"),
        (np.zeros((N, 4, LENGTH)), "(12, 4, 40) of float64"),
        (None, "(12,) of uint16"),  # of free length
    ],
)
def test_other_arrays_of_traces_are_named(tmp_path, values, said):
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        if values is None:
            rows = file.create_dataset("events/waveform", (N,), h5py.vlen_dtype(np.uint16))
            rows[0] = RAW[0]
        else:
            file["events/waveform"] = values
    for table in (None, "events", "events/waveform"):
        with pytest.raises(CpunetError, match=f"it holds events/waveform {re.escape(said)}"):
            open_pulses(tmp_path / "raw.h5", table=table)
