"""What others published: the Majorana release, and the pickled pulses of CPU-Net."""

from __future__ import annotations

import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.reading import open_pulses, tables_of
from synthetic import decay, phased_edges

KEV = 2614.511
N = 240
SHORT = {
    "training.steps": 1,
    "training.components": 4,
    "training.squares": 2,
    "training.start_factors": [1],
    "training.ringing_mhz": [],
    "training.noise_sets": 1,
    "scores.bootstraps": 20,
}


def measured(rng: np.random.Generator, n: int, length: int, start: int) -> np.ndarray:
    traces = 200 + 2 * KEV * phased_edges(n, rng, start, length) * decay(start, 5000, length)
    return np.round(traces + rng.normal(0, 4, traces.shape))


def write_majorana(path: Path, n: int = 2 * N, *, labels: bool = True, length: int = 3800):
    """Datasets at the top of the file, as Table I of arXiv:2308.10856 has them."""
    rng = np.random.default_rng(7)
    traces = measured(rng, n, length, 1100 if length > 2000 else 15)
    with h5py.File(path, "w") as file:
        file["raw_waveform"] = traces
        file["tp0"] = np.full(n, 1090)
        file["detector"] = np.where(np.arange(n) % 3 == 1, 9, 5)
        file["run_number"] = np.full(n, 60001)
        file["id"] = 10 * np.arange(n)
        if labels:
            file["energy_label"] = np.full(n, KEV)
            for cut in ("low_avse", "high_avse", "dcr", "lq"):
                file[f"psd_label_{cut}"] = np.arange(n) % 2
    return traces


def test_one_detector_of_the_majorana_release(tmp_path, monkeypatch):
    file = tmp_path / "MJD_Train_0.hdf5"
    traces = write_majorana(file, 50, length=40)
    assert tables_of(file) == ["5", "9"]
    monkeypatch.setattr("cpunet.pulses.reading.majorana._SLAB_BYTES", 7 * 40 * 8)
    source = open_pulses(file, table="9", dt_ns=10)
    rows = np.arange(1, 50, 3)
    assert (source.n_pulses, source.length, source.dt_ns) == (len(rows), 40, 10)
    blocks = list(source.blocks(4))
    assert [len(block) for block in blocks] == [4, 4, 4, 4, 1]
    pulses = source.read()
    np.testing.assert_array_equal(pulses.waveforms, traces[rows].astype(np.float32))
    np.testing.assert_array_equal(pulses.event_number, 10 * rows)
    np.testing.assert_array_equal(pulses.energy_kev, KEV)
    np.testing.assert_array_equal(np.concatenate([b.waveforms for b in blocks]), traces[rows])
    labels = source.columns["psd_label_low_avse"].read(0, len(rows))
    np.testing.assert_array_equal(labels, rows % 2)
    told = source.describe()
    assert (told["format"], told["table"]) == ("Majorana release", "9")
    assert told["energy"] == "column energy [keV]"


def test_all_detectors_and_files_without_labels(tmp_path):
    file = tmp_path / "MJD_NPML_0.hdf5"
    write_majorana(file, 6, labels=False, length=40)
    source = open_pulses(file, table="raw_waveform", dt_ns=10)
    assert source.n_pulses == 6
    assert source.describe()["energy"] == "not known"
    with h5py.File(file, "r+") as content:
        content["detector"][...] = 5
    assert len(open_pulses(file, dt_ns=10).read()) == 6


def test_what_is_wrong_with_a_majorana_file(tmp_path):
    file = tmp_path / "MJD_Test_0.hdf5"
    write_majorana(file, 6, length=40)
    with pytest.raises(CpunetError, match=r"2 detectors \(5, 9\); choose one with `table`"):
        open_pulses(file, dt_ns=10)
    with pytest.raises(CpunetError, match=r"no detector 7; there are 5, 9$"):
        open_pulses(file, table="7", dt_ns=10)
    with pytest.raises(
        CpunetError, match=r"not in the file; give `dt_ns` \(the Majorana.*10\)"
    ):
        open_pulses(file, table="5")
    with h5py.File(file, "r+") as content:  # then it is any HDF5 file
        del content["id"]
        del content["detector"]
    with pytest.raises(CpunetError, match="an array of two dimensions"):
        open_pulses(file, dt_ns=10)


def write_pickles(path: Path, traces: np.ndarray, *, lists: bool = False, **more: object):
    found = [
        {"wf": trace, "tp0": 400 + i, "energy": KEV + i / 1000, **more}
        for i, trace in enumerate(traces)
    ]
    with path.open("wb") as stream:
        for one in [found] if lists else found:
            pickle.dump(one, stream)
    return path


@pytest.mark.parametrize("lists", [False, True])
def test_pickled_pulses(tmp_path, lists):
    traces = np.random.default_rng(1).normal(size=(23, 40))
    file = write_pickles(tmp_path / "fep_wf_ornl.pickle", traces, lists=lists, dc_label=0.0)
    source = open_pulses(file, dt_ns=16)
    assert (source.n_pulses, source.length) == (None, 40)
    told = source.describe()
    assert (told["format"], told["energy"]) == ("pickled pulses", "column energy [keV]")
    assert told["columns"] == ["dc_label", "energy", "tp0"]
    columns = source.columns
    np.testing.assert_array_equal(columns["tp0"].read(3, 5), [403, 404])  # before any trace
    blocks = list(source.blocks(5))
    assert [len(block) for block in blocks] == [5, 5, 5, 5, 3]
    pulses = source.read()
    np.testing.assert_array_equal(pulses.waveforms, traces.astype(np.float32))
    np.testing.assert_allclose(pulses.energy_kev, KEV + np.arange(23) / 1000)
    np.testing.assert_array_equal(pulses.event_number, np.arange(23))
    assert len(columns["tp0"]) == 23
    assert open_pulses(file, energy="tp0", kev_per_adc=2, dt_ns=16).read().energy_kev[1] == 802


DEFECTS = {
    "no period": (
        {"dt_ns": None},
        r"give `dt_ns` \(CPU-Net's pulses are sampled every 16 ns\)",
    ),
    "a table": ({"table": "x"}, r"has no tables; leave out `table`"),
    "no pulse": ({"then": 5}, r"entry 3 is no pulse \(no dictionary with wf\)"),
    "no numbers": (
        {"then": {"wf": np.zeros(40), "energy": "much"}},
        r"entry 3 is no pulse \(holds something other than numbers\); write the pulses",
    ),
    "other length": (
        {"then": {"wf": np.zeros(39)}},
        r"entry 3: 39 samples, before it 40; write the pulses of one length",
    ),
    "cut off": ({"cut": 20}, r"breaks off after \d entries .*; download it again"),
    "empty list": ({"only": []}, r"pickled pulses holds no pulses; give a file with events"),
    "no pulses": ({"only": "words"}, r"entry 0 is no pulse"),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_what_is_wrong_with_a_pickle_is_one_line(tmp_path, defect):
    how, words = DEFECTS[defect]
    file = write_pickles(tmp_path / "wf.pickle", np.zeros((3, 40)))
    with file.open("ab") as stream:
        if "then" in how:
            pickle.dump(how["then"], stream)
    if "cut" in how:
        file.write_bytes(file.read_bytes()[: -how["cut"]])
    if "only" in how:
        file.write_bytes(pickle.dumps(how["only"]))
    options = {"dt_ns": 16} | {k: v for k, v in how.items() if k in ("dt_ns", "table")}
    with pytest.raises(CpunetError, match=words) as error:
        open_pulses(file, **options).read()
    assert "\n" not in str(error.value)
