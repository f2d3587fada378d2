"""What others write: the Majorana release, and pickled pulses of CPU-Net."""

from __future__ import annotations

import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.reading import open_pulses, table_names

KEV = 2614.511


def test_the_layout_of_the_majorana_release(tmp_path):
    """Datasets at the top of the file, as Table I of arXiv:2308.10856 has them."""
    file, traces = tmp_path / "MJD_Train_0.hdf5", np.random.default_rng(7).normal(size=(6, 40))
    with h5py.File(file, "w") as content:
        content["raw_waveform"], content["energy_label"] = traces, KEV + np.arange(6)
        content["detector"], content["id"] = [5, 9, 5, 9, 5, 5], 10 * np.arange(6)
        content["run_number"], content["psd_label_dcr"] = np.full(6, 60001), np.arange(6) % 2
    assert table_names(file) == ["detector=5", "detector=9"]
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
