"""NumPy files and HDF5 that is not LH5."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.reading import open_pulses

VALUES = np.random.default_rng(2).normal(size=(11, 30)).astype(np.float32)
ENERGY = np.linspace(500, 3000, 11)


def write_npz(path: Path, **arrays) -> Path:
    np.savez_compressed(path, **arrays)
    return path


def write_hdf5(path: Path, **arrays) -> Path:
    with h5py.File(path, "w") as h5:
        for name, values in arrays.items():
            h5[name] = values
    return path


WRITERS = [(write_npz, "pulses.npz"), (write_hdf5, "pulses.h5")]


@pytest.mark.parametrize(("write", "name"), WRITERS)
@pytest.mark.parametrize("waveform", ["waveform", "waveforms", "values"])
@pytest.mark.parametrize("dt_ns", [16.0, [16.0], np.full(11, 16.0)])
@pytest.mark.parametrize("energy", ["energy_kev", "energy_keV"])
def test_the_usual_names_are_understood(tmp_path, write, name, waveform, dt_ns, energy):
    arrays = {
        waveform: VALUES,
        "dt_ns": dt_ns,
        energy: ENERGY,
        "event_number": np.arange(11) * 3,
    }
    source = open_pulses(write(tmp_path / name, **arrays))
    assert (source.n_pulses, source.length, source.dt_ns) == (11, 30, 16.0)
    blocks = list(source.blocks(4))
    assert [len(block) for block in blocks] == [4, 4, 3]
    np.testing.assert_array_equal(np.concatenate([b.waveforms for b in blocks]), VALUES)
    np.testing.assert_array_equal(np.concatenate([b.energy_kev for b in blocks]), ENERGY)
    assert source.read().event_number.tolist() == list(range(0, 33, 3))


@pytest.mark.parametrize(("write", "name"), WRITERS)
def test_an_energy_without_units_is_not_in_kev(tmp_path, write, name):
    path = write(tmp_path / name, waveform=VALUES, dt_ns=16.0, energy=ENERGY)
    assert np.isnan(open_pulses(path).read().energy_kev).all()
    np.testing.assert_array_equal(open_pulses(path, kev_per_adc=1).read().energy_kev, ENERGY)


def test_a_choice_between_arrays(tmp_path):
    path = write_npz(tmp_path / "pulses.npz", wf1=VALUES, wf16=VALUES[:, ::2], note="text")
    with pytest.raises(CpunetError, match=r"2 arrays of two dimensions \(wf1, wf16\); choose"):
        open_pulses(path, dt_ns=16)
    assert open_pulses(path, table="wf16", dt_ns=16).length == 15
    with pytest.raises(CpunetError, match=r"no array wf2 .*; there are wf1, wf16"):
        open_pulses(path, table="wf2", dt_ns=16)


def test_npy_needs_the_period(tmp_path):
    path = tmp_path / "pulses.npy"
    np.save(path, VALUES)
    with pytest.raises(CpunetError, match="period is not in the file; give `dt_ns`"):
        open_pulses(path)
    np.testing.assert_array_equal(open_pulses(path, dt_ns=8).read().waveforms, VALUES)
    for dt_ns in (0, -1, np.nan):
        with pytest.raises(CpunetError, match=r"dt_ns is .*; expected more than 0"):
            open_pulses(path, dt_ns=dt_ns)


def test_columnwise_arrays_and_objects_beside_the_waveforms(tmp_path):
    path = write_npz(tmp_path / "pulses.npz", waveform=np.asfortranarray(VALUES), more={"a": 1})
    read = open_pulses(path, dt_ns=16).read()
    np.testing.assert_array_equal(read.waveforms, VALUES)


def test_simulated_reference_pulses(reference_data: Path):
    path = reference_data / "siggen" / "waveforms_plain_A_outertaper_grid0.1.npz"
    pulses = open_pulses(path, table="wf16", dt_ns=16).read()
    with np.load(path) as arrays:
        np.testing.assert_array_equal(pulses.waveforms, arrays["wf16"])
