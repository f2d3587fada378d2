"""FlashCam files, measured and written here byte by byte."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from cpunet import info
from cpunet.errors import CpunetError
from cpunet.pulses.reading import open_pulses, tables_of

LENGTH = 64


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
    records = [
        config(3),
        event(10, {0: trace(0), 1: trace(1), 2: trace(2)}),
        event(11, {0: trace(3), 2: trace(4)}, sparse=True),
        event(12, {1: trace(5)}, sparse=True),
        event(13, {0: trace(6), 1: trace(7), 2: trace(8)}),
    ]
    path = write(tmp_path / "run.fcio", *records)
    pulses = open_pulses(path, table="2").read()
    np.testing.assert_array_equal(pulses.waveforms, [trace(2), trace(4), trace(8)])
    assert pulses.event_number.tolist() == [10, 11, 13]
    assert np.isnan(pulses.energy_kev).all()
    with pytest.raises(CpunetError, match=r"3 channels \(0, 1, 2\); choose one with `table`"):
        open_pulses(path)
    with pytest.raises(CpunetError, match=r"no channel 3; there are 0, 1, 2"):
        open_pulses(path, table="3")


def test_channels_with_traces_are_listed_and_counted(tmp_path):
    records = [config(4), event(0, {0: trace(0), 3: trace(1)}, sparse=True)]
    records.append(event(1, {3: trace(2)}, sparse=True))
    path = write(tmp_path / "run.fcio", *records)
    assert tables_of(path) == ["0", "3"]
    told = info(path).values
    assert {name: one["n_pulses"] for name, one in told.items()} == {"0": 1, "3": 2}
    one = write(tmp_path / "one.fcio", config(1), event(0, {0: trace(0)}))
    assert tables_of(one) == ["0"]
    path.write_bytes(path.read_bytes()[:-30])
    assert tables_of(path) == ["0", "3"]  # what reads the traces tells that it is cut off


@pytest.mark.parametrize(("bits", "dt_ns"), [(16, 16.0), (12, 4.0)])
def test_the_digitiser_sets_the_period(tmp_path, bits, dt_ns):
    path = write(tmp_path / "run.fcio", config(1, bits), event(0, {0: trace(0)}))
    assert open_pulses(path).dt_ns == dt_ns
    with pytest.raises(CpunetError, match="drop `dt_ns`"):
        open_pulses(path, dt_ns=10)


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
