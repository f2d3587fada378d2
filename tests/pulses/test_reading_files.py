"""NumPy, HDF5 that is not LH5, and what is wrong with files."""

from __future__ import annotations

from pathlib import Path

import awkward as ak
import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading import open_pulses
from synthetic import write_pulses

VALUES = np.random.default_rng(2).normal(size=(11, 30)).astype(np.float32)
ENERGY = np.linspace(500, 3000, 11)


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
