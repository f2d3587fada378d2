"""What others write: the Majorana release, pickled pulses of CPU-Net, and FlashCam's files."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path

import h5py
import numpy as np
import pytest

from cpunet import info
from cpunet.errors import CpunetError
from cpunet.pulses.reading import open_pulses, table_sizes

KEV = 2614.511
TEXT = {"wf": np.zeros(40), "energy": "much"}
DEFECTS = {
    "no period": ({"dt_ns": None}, r"the sampling period is not in the file; give `dt_ns`"),
    "a table": ({"table": "x"}, r"has no tables; leave out `table`"),
    "no pulse": ({"then": 5}, r"entry 3 is no pulse \(a dictionary of wf"),
    "no numbers": ({"then": TEXT}, r"entry 3 is no pulse .* numbers\); write the pulses"),
    "other length": ({"then": {"wf": np.zeros(39)}}, r"3: 39 samples, before it 40; write the"),
    "cut off": ({"cut": 20}, r"breaks off after \d entries .*; download it again"),
    "empty list": ({"only": []}, r"pickled pulses holds no pulses; give a file with events"),
    "no pulses": ({"only": "words"}, r"entry 0 is no pulse"),
}
LENGTH = 64


def test_the_layout_of_the_majorana_release(tmp_path):
    """Datasets at the top of the file, as Table I of arXiv:2308.10856 has them."""
    file, traces = tmp_path / "MJD_Train_0.hdf5", np.random.default_rng(7).normal(size=(6, 40))
    with h5py.File(file, "w") as content:
        content["raw_waveform"], content["energy_label"] = traces, KEV + np.arange(6)
        content["detector"], content["id"] = [5, 9, 5, 9, 5, 5], 10 * np.arange(6)
        content["run_number"], content["psd_label_dcr"] = np.full(6, 60001), np.arange(6) % 2
    assert [*table_sizes(file)] == ["detector=5", "detector=9"]
    with pytest.raises(CpunetError, match=r"2 channels or detectors .* `table` detector=5"):
        open_pulses(file, dt_ns=10)
    with pytest.raises(CpunetError, match="not in the file; give `dt_ns`"):
        open_pulses(file, table="detector=5")
    source = open_pulses(file, table="detector=9", dt_ns=10)
    assert source.energies == "column energy_label [keV]"
    np.testing.assert_array_equal(source.columns["id"].values, [10, 30])
    np.testing.assert_array_equal(source.read().waveforms, traces[[1, 3]].astype(np.float32))
    np.testing.assert_array_equal(source.read().energy_kev, KEV + np.array([1, 3]))
    source.close()
    with h5py.File(file, "r+") as content:
        del content["energy_label"]
    source = open_pulses(file, table="detector=*", dt_ns=10)
    assert (source.n_pulses, source.energies) == (6, "not known")


def write_pickles(path: Path, traces: np.ndarray, *, lists: bool = False, **more: object):
    pulses = [
        {"wf": trace, "tp0": 400 + i, "energy": KEV + i / 1000, **more}
        for i, trace in enumerate(traces)
    ]
    path.write_bytes(b"".join(pickle.dumps(each) for each in ([pulses] if lists else pulses)))
    return path


@pytest.mark.parametrize("lists", [False, True])
def test_pickled_pulses(tmp_path, lists):
    traces = np.random.default_rng(1).normal(size=(23, 40))
    file = write_pickles(tmp_path / "fep_wf_ornl.pickle", traces, lists=lists, dc_label=0.0)
    source = open_pulses(file, dt_ns=16)
    assert (source.n_pulses, source.length, source.format) == (23, 40, "pickled pulses")
    assert source.energies == "column energy [keV]"
    assert sorted(source.columns) == ["dc_label", "energy", "event_number", "tp0"]
    np.testing.assert_array_equal(source.columns["tp0"].values, 400 + np.arange(23))
    assert [len(block) for block in source.blocks(5)] == [5, 5, 5, 5, 3]
    pulses = source.read()
    np.testing.assert_array_equal(pulses.waveforms, traces.astype(np.float32))
    np.testing.assert_allclose(pulses.energy_kev, KEV + np.arange(23) / 1000)
    np.testing.assert_array_equal(pulses.event_number, np.arange(23))
    assert open_pulses(file, energy="tp0", kev_per_adc=2, dt_ns=16).read().energy_kev[1] == 802


@pytest.mark.parametrize("defect", DEFECTS)
def test_what_is_wrong_with_a_pickle_is_one_line(tmp_path, defect):
    how, words = DEFECTS[defect]
    file = write_pickles(tmp_path / "wf.pickle", np.zeros((3, 40)))
    if "then" in how:
        file.write_bytes(file.read_bytes() + pickle.dumps(how["then"]))
    if "cut" in how:
        file.write_bytes(file.read_bytes()[: -how["cut"]])
    if "only" in how:
        file.write_bytes(pickle.dumps(how["only"]))
    options = {"dt_ns": 16} | {k: v for k, v in how.items() if k in ("dt_ns", "table")}
    with pytest.raises(CpunetError, match=words):
        open_pulses(file, **options).read()


def frame(kind: str, *values) -> bytes:
    data = struct.pack(f"<{len(values)}{kind}", *values)
    return struct.pack("<i", len(data)) + data


def config(channels: int, adc_bits: int = 16) -> bytes:
    """Record 1: adcs, triggers, samples, precision, sum length, bits, cards, gps, trace map."""
    fields = (channels, 0, LENGTH, 1, 1, adc_bits, 0, 0, 1, 0)
    trace_map = frame("i", *range(channels))
    return struct.pack("<i", -1) + b"".join(frame("i", v) for v in fields) + trace_map


def event(number: int, traces: dict[int, np.ndarray], *, sparse: bool = False) -> bytes:
    """Record 3 holds all channels, record 6 a list of them; each has two words in front."""
    start = struct.pack("<i", -6 if sparse else -3) + frame("i", 1) + frame("f", 0.0)
    stamps = frame("i", *[0] * 10) + frame("i", number, *[0] * 9)
    dead = frame("i", *[0] * 10)
    rows = [frame("H", 0, 0, *trace)[4:] for trace in traces.values()]
    if not sparse:
        joined = b"".join(rows)
        return start + stamps + struct.pack("<i", len(joined)) + joined + dead
    listed = frame("i", len(traces)) + frame("H", *traces)
    each = b"".join(struct.pack("<i", len(row)) + row for row in rows)
    return start + stamps + dead + listed + each


def write(path: Path, *records: bytes) -> Path:
    magic = b"\xff\x35\x65\xc4" + b"FlashCamV1".ljust(64, b"\0")
    path.write_bytes(magic + b"".join(records))
    return path


def trace(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 65535, LENGTH)


def test_full_and_sparse_events_of_one_channel(tmp_path):
    path = write(
        tmp_path / "run.fcio",
        config(3),
        event(10, {0: trace(0), 1: trace(1), 2: trace(2)}),
        event(11, {0: trace(3), 2: trace(4)}, sparse=True),
        event(12, {1: trace(5)}, sparse=True),
        event(13, {0: trace(6), 1: trace(7), 2: trace(8)}),
    )
    pulses = open_pulses(path, table="2").read()
    np.testing.assert_array_equal(pulses.waveforms, [trace(2), trace(4), trace(8)])
    assert pulses.event_number.tolist() == [10, 11, 13]
    assert np.isnan(pulses.energy_kev).all()
    with pytest.raises(CpunetError, match=r"3 channels \(0, 1, 2\); choose one with `table`"):
        open_pulses(path)
    with pytest.raises(CpunetError, match=r"no channel 3; there are 0, 1, 2"):
        open_pulses(path, table="3")


def test_channels_with_traces_are_listed_and_counted(tmp_path):
    first, second = {0: trace(0), 3: trace(1)}, {3: trace(2)}
    events = event(0, first, sparse=True), event(1, second, sparse=True)
    path = write(tmp_path / "run.fcio", config(4), *events)
    assert [*table_sizes(path)] == ["0", "3"]
    rows = [line.split()[:2] for line in str(info(path)).splitlines()]
    assert rows[1:3] == [["0", "1"], ["3", "2"]]
    one = write(tmp_path / "one.fcio", config(1), event(0, {0: trace(0)}))
    assert [*table_sizes(one)] == ["0"]
    path.write_bytes(path.read_bytes()[:-30])
    assert [*table_sizes(path)] == ["0", "3"]  # what reads the traces tells that it is cut off


@pytest.mark.parametrize(("bits", "dt_ns"), [(16, 16.0), (12, 4.0)])
def test_the_digitiser_sets_the_period(tmp_path, bits, dt_ns):
    path = write(tmp_path / "run.fcio", config(1, bits), event(0, {0: trace(0)}))
    assert open_pulses(path).dt_ns == dt_ns
    assert open_pulses(path, dt_ns=10).dt_ns == 10


def test_a_cut_off_file_gives_its_whole_events_and_then_an_error(tmp_path):
    events = [event(i, {0: trace(i)}) for i in range(5)]
    path = write(tmp_path / "run.fcio", config(1), *events)
    whole = path.read_bytes()
    path.write_bytes(whole[:-30])
    blocks = open_pulses(path).blocks(1)
    for i in range(4):
        np.testing.assert_array_equal(next(blocks).waveforms[0], trace(i))
    with pytest.raises(CpunetError, match=r"run.fcio: event 4: the file is cut off; copy"):
        next(blocks)
    path.write_bytes(whole[:80])
    with pytest.raises(CpunetError, match=r"run.fcio"):
        open_pulses(path).read()


def test_measured_traces_equal_their_copy_in_hdf5(reference_data: Path):
    folder = reference_data / "real"
    pulses = open_pulses(folder / "th228.fcio", kev_per_adc=2614.5 / 40265).read()
    copy = open_pulses(folder / "hpge_real_waveforms.h5", table="th228_fcio").read()
    np.testing.assert_array_equal(pulses.waveforms, copy.waveforms)
    assert pulses.dt_ns == copy.dt_ns == 16
    # A better energy is in the copy: single pulses on a flat baseline agree within 2 %.
    good = (copy.energy_kev > 300) & (np.ptp(copy.waveforms[:, :200], axis=1) < 200)
    ratio = pulses.energy_kev[good] / copy.energy_kev[good]
    assert good.sum() > 200
    assert np.abs(np.median(ratio) - 1) < 0.02
