"""NumPy, HDF5, what others write (Majorana's release, pickles, FlashCam), and what is wrong."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path

import awkward as ak
import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cpunet import info
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading import open_pulses, table_sizes
from synthetic import write_pulses

VALUES = np.random.default_rng(2).normal(size=(11, 30)).astype(np.float32)
ENERGY = np.linspace(500, 3000, 11)
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
SAMPLES = 64


def write_npz(path: Path, **arrays) -> Path:
    np.savez_compressed(path, **arrays)
    return path


def write_hdf5(path: Path, **arrays) -> Path:
    with h5py.File(path, "w") as h5:
        h5.update(arrays)
    return path


formats = pytest.mark.parametrize(
    ("write", "name"), [(write_npz, "pulses.npz"), (write_hdf5, "pulses.h5")]
)


@formats
@pytest.mark.parametrize("waveform", ["waveform", "waveforms", "values"])
@pytest.mark.parametrize("dt_ns", [16.0, [16.0], np.full(11, 16.0)])
@pytest.mark.parametrize("energy", ["energy_kev", "energy_keV"])
def test_the_usual_names_are_understood(tmp_path, write, name, waveform, dt_ns, energy):
    numbers = np.arange(11) * 3
    arrays = {waveform: VALUES, "dt_ns": dt_ns, energy: ENERGY, "event_number": numbers}
    source = open_pulses(write(tmp_path / name, **arrays))
    assert (source.n_pulses, source.length, source.dt_ns) == (11, 30, 16.0)
    blocks = list(source.blocks(4))
    assert [len(block) for block in blocks] == [4, 4, 3]
    pulses = Pulses.concatenate(blocks)
    np.testing.assert_array_equal(pulses.waveforms, VALUES)
    np.testing.assert_array_equal(pulses.energy_kev, ENERGY)
    np.testing.assert_array_equal(pulses.event_number, numbers)


def test_a_choice_between_arrays(tmp_path):
    path = write_npz(tmp_path / "pulses.npz", wf1=VALUES, wf16=VALUES[:, ::2], note="text")
    assert open_pulses(path, table="wf16", dt_ns=16).length == 15
    several = r"2 arrays of two dimensions \(wf1, wf16\); choose"
    for table, said in ((None, several), ("wf2", "no array wf2; there are wf1, wf16")):
        with pytest.raises(CpunetError, match=said):
            open_pulses(path, table=table, dt_ns=16)


def test_npy_needs_the_period(tmp_path):
    path = tmp_path / "pulses.npy"
    np.save(path, VALUES)
    with pytest.raises(CpunetError, match="period is not in the file; give `dt_ns`"):
        open_pulses(path)
    np.testing.assert_array_equal(open_pulses(path, dt_ns=8).read().waveforms, VALUES)
    for dt_ns in (0, -1, np.nan):
        with pytest.raises(CpunetError, match=r"dt_ns is .*; expected more than 0"):
            open_pulses(path, dt_ns=dt_ns)


@formats
@pytest.mark.parametrize("orient", [np.ravel, np.atleast_2d, np.vstack])
@pytest.mark.parametrize("n", [1, 7])
def test_columns_of_a_format_without_vectors(tmp_path, write, name, orient, n):
    """MATLAB writes a row or a column: https://github.com/scipy/scipy/issues/13093."""
    arrays = {"waveform": VALUES[:n], "dt_ns": [[8.0]], "energy_kev": orient(ENERGY[:n])}
    pulses = open_pulses(write(tmp_path / name, **arrays)).read()
    np.testing.assert_array_equal(pulses.waveforms, VALUES[:n])
    np.testing.assert_array_equal(pulses.energy_kev, ENERGY[:n])
    assert pulses.dt_ns == 8


@formats
def test_reversed_dimensions_are_named(tmp_path, write, name):
    path = write(tmp_path / name, waveform=VALUES.T, energy_kev=ENERGY)
    with pytest.raises(CpunetError, match=rf"{name}: .*\(30, 11\) .* reversed; .* transposed"):
        open_pulses(path, dt_ns=16)


def test_datasets_and_attributes_without_values(tmp_path):
    """HDF5's null dataspaces, as of netCDF: https://github.com/h5py/h5py/issues/279."""
    path = tmp_path / "null.h5"
    with h5py.File(path, "w") as file:
        file.attrs["side"] = h5py.Empty("S1")
        file["waveform"], file["energy"], file["dt"] = np.ones((3, 40)), np.arange(3.0), 16.0
        file["energy"].attrs["units"], file["dt"].attrs["units"] = "keV", "ns"
        file["energy"].attrs["unit"] = file["waveform"].attrs["units"] = h5py.Empty("S4")
        file["event_number"] = file["comment"] = h5py.Empty("i8")
    pulses = open_pulses(path).read()
    np.testing.assert_array_equal(pulses.energy_kev, np.arange(3.0))
    np.testing.assert_array_equal(pulses.event_number, np.arange(3))
    with h5py.File(path, "r+") as file:
        file["dt"].attrs["units"] = h5py.Empty("S4")
    with pytest.raises(CpunetError, match=r"\(dt\) has no units; give `dt_ns`"):
        open_pulses(path)


def test_what_is_missing_is_unknown_in_arrays_of_any_kind():
    """NumPy drops masks without a word: https://github.com/numpy/numpy/issues/26669."""
    masked = np.ma.masked_array([1.0, 2.0, 3.0], [False, True, False])
    pulses = Pulses.of(np.ma.masked_less(np.eye(3), 0.5), dt_ns=16, energy_kev=masked)
    np.testing.assert_array_equal(pulses.energy_kev, [1, np.nan, 3])
    assert np.isnan(pulses.waveforms).sum() == 6
    for rows, energies, name in (
        (np.eye(2), ak.Array([1.0, None]), "energy_kev"),
        (ak.Array([[1.0, 2.0], [1.0]]), None, "waveforms"),
        ([[1.0, 2.0], [1.0]], None, "waveforms"),
    ):
        with pytest.raises(CpunetError, match=f"{name}: no plain numbers .*; give rows of"):
            Pulses.of(rows, dt_ns=16, energy_kev=energies)
    jagged = ak.from_regular(ak.Array(np.eye(3)))  # as uproot reads vectors of equal length
    np.testing.assert_array_equal(Pulses.of(jagged, dt_ns=16).waveforms, np.eye(3))


@pytest.mark.parametrize("suffix", [".lh5", ".fcio", ".npz", ""])
@pytest.mark.parametrize(
    ("start", "words"),
    [
        (None, "is empty; copy"),
        (b"\x89PNG\r\n\x1a\n", "of no known format; give LH5"),
        (b"", "of no known format; give LH5"),  # zeros
        (b"root\0\0", "is a ROOT file, which is not read; read its traces with uproot"),
        (b"\xe7\xca", "is a CAEN CoMPASS file, .*; convert it with legend-daq2lh5"),
        (b"\x1f\x8b\x08", "is a compressed file, which is not read; unpack it"),
        (b"MATLAB 5.0 MAT-file", "is a MATLAB 5 file, .*; save it with -v7.3"),
    ],
)
def test_foreign_files_are_named_by_their_content(tmp_path, suffix, start, words):
    """As of CoMPASS, https://github.com/legend-exp/pygama/pull/23."""
    path = tmp_path / f"run_1{suffix}"
    path.write_bytes(b"" if start is None else start + bytes(700))
    with pytest.raises(CpunetError, match=rf"^[^\n]*run_1{suffix}: {words}[^\n]*$"):
        open_pulses(path, dt_ns=16)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> list[Path]:
    """A file of each format."""
    folder = tmp_path_factory.mktemp("whole")
    values = np.random.default_rng(3).normal(size=(30, 40)).astype("<f4")
    write_pulses(folder / "a.lh5", Pulses.of(values, dt_ns=16, energy_kev=np.arange(30.0)))
    np.savez(folder / "b.npz", waveform=values, energy_kev=np.arange(30.0))
    np.savez_compressed(folder / "c.npz", waveform=values)
    np.save(folder / "d.npy", values)
    return sorted(folder.iterdir())


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(fraction=st.floats(0, 0.99), which=st.integers(0, 3))
def test_any_truncation_is_one_line_naming_the_file(whole, fraction, which):
    content = whole[which].read_bytes()
    path = whole[which].with_stem("cut")
    path.write_bytes(content[: int(fraction * len(content))])
    dt_ns = None if path.suffix == ".lh5" else 16
    with pytest.raises(CpunetError, match=r"^[^\n]+; [^\n]+$") as error:
        open_pulses(path, dt_ns=dt_ns).read()
    assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize("shape", [5, (5, 4, 4), None])
def test_lh5_values_that_are_no_traces(tmp_path, shape):
    path = tmp_path / "file.lh5"
    write_pulses(path, Pulses.of(np.zeros((5, 20)), dt_ns=16))
    values = np.full((5, 9), b"a") if shape is None else np.zeros(shape)
    with h5py.File(path, "r+") as file:
        old = "geds/sim/waveform/values"
        attributes = dict(file[old].attrs)
        del file[old]
        file[old] = values
        file[old].attrs.update(attributes)
    with pytest.raises(CpunetError, match=r"file.lh5: [^\n]*; [^\n]*$"):
        open_pulses(path)


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
    fields = (channels, 0, SAMPLES, 1, 1, adc_bits, 0, 0, 1, 0)
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


def write_fcio(path: Path, *records: bytes) -> Path:
    magic = b"\xff\x35\x65\xc4" + b"FlashCamV1".ljust(64, b"\0")
    path.write_bytes(magic + b"".join(records))
    return path


def trace(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 65535, SAMPLES)


def test_full_and_sparse_events_of_one_channel(tmp_path):
    path = write_fcio(
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
    path = write_fcio(tmp_path / "run.fcio", config(4), *events)
    assert [*table_sizes(path)] == ["0", "3"]
    rows = [line.split()[:2] for line in str(info(path)).splitlines()]
    assert rows[1:3] == [["0", "1"], ["3", "2"]]
    one = write_fcio(tmp_path / "one.fcio", config(1), event(0, {0: trace(0)}))
    assert [*table_sizes(one)] == ["0"]
    path.write_bytes(path.read_bytes()[:-30])
    assert [*table_sizes(path)] == ["0", "3"]  # what reads the traces tells that it is cut off


@pytest.mark.parametrize(("bits", "dt_ns"), [(16, 16.0), (12, 4.0)])
def test_the_digitiser_sets_the_period(tmp_path, bits, dt_ns):
    path = write_fcio(tmp_path / "run.fcio", config(1, bits), event(0, {0: trace(0)}))
    assert open_pulses(path).dt_ns == dt_ns
    assert open_pulses(path, dt_ns=10).dt_ns == 10


def test_a_cut_off_file_gives_its_whole_events_and_then_an_error(tmp_path):
    events = [event(i, {0: trace(i)}) for i in range(5)]
    path = write_fcio(tmp_path / "run.fcio", config(1), *events)
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
