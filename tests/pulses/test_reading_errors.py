"""Whatever is wrong with a file, the user gets one line."""

from __future__ import annotations

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.writing import write_pulses

PNG = b"\x89PNG\r\n\x1a\n" + bytes(600)


@pytest.mark.parametrize("suffix", [".lh5", ".h5", ".fcio", ".npz", ".npy", ".spe", ".dat", ""])
@pytest.mark.parametrize("content", [b"", PNG, b"\0" * 700], ids=["empty", "png", "zeros"])
def test_foreign_files(tmp_path, suffix, content):
    path = tmp_path / f"file{suffix}"
    path.write_bytes(content)
    with pytest.raises(CpunetError, match=r"^[^\n]*file[^\n]*: [^\n]*; [^\n]*$") as error:
        open_pulses(path, dt_ns=16)
    assert ("is empty" in str(error.value)) == (content == b"")


def test_content_counts_more_than_the_name(tmp_path):
    pulses = Pulses.of(np.zeros((2, 20)), dt_ns=16)
    write_pulses(tmp_path / "pulses.npz", pulses)
    assert open_pulses(tmp_path / "pulses.npz").describe()["format"] == "LH5"


def write_all(folder: Path) -> list[Path]:
    values = np.random.default_rng(3).normal(size=(30, 40)).astype("<f4")
    pulses = Pulses.of(values, dt_ns=16, energy_kev=np.arange(30.0))
    write_pulses(folder / "a.lh5", pulses)
    np.savez(folder / "b.npz", waveform=values, energy_kev=np.arange(30.0))
    np.savez_compressed(folder / "c.npz", waveform=values)
    np.save(folder / "d.npy", values)
    head = struct.pack("<i8siiiiii", 24, b"p" * 8, 40, 30, 1, 1, 24, values.nbytes)
    (folder / "e.spe").write_bytes(head + values.tobytes() + head[-4:])
    return sorted(folder.iterdir())


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(fraction=st.floats(0, 0.99), which=st.integers(0, 4))
def test_any_truncation_is_one_line_naming_the_file(tmp_path_factory, fraction, which):
    folder = tmp_path_factory.mktemp("cut")
    path = write_all(folder)[which]
    whole = path.read_bytes()
    path.write_bytes(whole[: int(fraction * len(whole))])
    dt_ns = None if path.suffix == ".lh5" else 16
    with pytest.raises(CpunetError, match=r"^[^\n]+; [^\n]+$") as error:
        open_pulses(path, dt_ns=dt_ns).read()
    assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    "values",
    [np.zeros(5), np.zeros((5, 4, 4)), np.full((5, 9), b"a")],
    ids=["1d", "3d", "text"],
)
def test_lh5_values_that_are_no_traces(tmp_path, values):
    path = tmp_path / "file.lh5"
    write_pulses(path, Pulses.of(np.zeros((5, 20)), dt_ns=16))
    with h5py.File(path, "r+") as file:
        old = "geds/sim/waveform/values"
        attributes = dict(file[old].attrs)
        del file[old]
        file[old] = values
        file[old].attrs.update(attributes)
    with pytest.raises(CpunetError, match=r"file.lh5: [^\n]*; [^\n]*$"):
        open_pulses(path)
