"""Files that are damaged in ways that nobody would write: one line, soon, in little memory."""

from __future__ import annotations

import os
import re
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest
from lgdo import Array, ArrayOfEqualSizedArrays, Table, VectorOfVectors, WaveformTable
from lh5.compression import RadwareSigcompress, ULEB128ZigZagDiff

from cpunet.errors import CpunetError
from cpunet.hdf5_files import require_all_stored
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.reading.source import BLOCK_BYTES, MAX_SAMPLES

N, LENGTH = 12, 64


def waveforms() -> np.ndarray:
    rng = np.random.default_rng(8)
    return rng.integers(900, 1100, (N, LENGTH)).astype(np.uint16)


def write(path: Path, *, codec: object = None, ragged: bool = False) -> Path:
    values = waveforms()
    held = (
        VectorOfVectors(values.tolist(), dtype=np.uint16)
        if ragged
        else ArrayOfEqualSizedArrays(nda=values)
    )
    if codec is not None:
        held.attrs["compression"] = codec
    table = WaveformTable(
        t0=np.zeros(N), t0_units="ns", dt=np.full(N, 16.0), dt_units="ns", values=held
    )
    numbers = Array(np.arange(float(N)))
    lh5.write(Table(col_dict={"waveform": table, "event_number": numbers}), "raw", path)
    return path


def changed(path: Path, change: Callable[[h5py.File], None]) -> Path:
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def replaced(name: str, values: object, **options: object) -> Callable[[h5py.File], None]:
    """Replace a dataset, with its attributes."""

    def change(file: h5py.File) -> None:
        attributes = dict(file[name].attrs)
        del file[name]
        made = file.create_dataset(name, data=values, **options)
        made.attrs.update(attributes)

    return change


def claimed(name: str, shape: tuple[int, ...], kind: str, chunks: object) -> Callable:
    """Replace a dataset by one of that shape without any values."""

    def change(file: h5py.File) -> None:
        attributes = dict(file[name].attrs)
        del file[name]
        made = file.create_dataset(name, shape, kind, chunks=chunks)
        made.attrs.update(attributes)

    return change


def retyped(name: str, datatype: str) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[name].attrs["datatype"] = datatype

    return change


def with_bytes(name: str, at: int, value: int) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        values = file[name][()]
        values[at] = value
        file[name][...] = values

    return change


pytestmark = pytest.mark.probed
VALUES = "raw/waveform/values"
ENDS, FLAT = f"{VALUES}/cumulative_length", f"{VALUES}/flattened_data"
CODES = f"{VALUES}/encoded_data/flattened_data"
ENCODED_ENDS = f"{VALUES}/encoded_data/cumulative_length"
RAGGED, VARLEN, RADWARE = {"ragged": True}, {"codec": ULEB128ZigZagDiff()}, {
    "codec": RadwareSigcompress(codec_shift=-32768)
}  # fmt: skip
RISING = np.arange(1, N + 1) * LENGTH

# name → (how the file is written, change)
DEFECTS: dict[str, tuple[dict, Callable[[h5py.File], None]]] = {
    "negative lengths": (RAGGED, replaced(ENDS, -RISING)),
    "falling lengths": (RAGGED, replaced(ENDS, RISING[::-1].copy())),
    "huge lengths": (RAGGED, replaced(ENDS, RISING.astype(np.uint64) << np.uint64(50))),
    "lengths beyond": (RAGGED, replaced(ENDS, RISING + np.eye(1, N, N - 1, int)[0] * 10**15)),
    "lengths as text": (RAGGED, replaced(ENDS, [b"a"] * N)),
    "no lengths": (RAGGED, lambda file: file.__delitem__(ENDS)),
    "no samples": (RAGGED, lambda file: file.__delitem__(FLAT)),
    "rows that are not there": ({}, claimed(VALUES, (10**8, LENGTH), "u2", (64, LENGTH))),
    "samples without end": ({}, claimed(VALUES, (N, 10**7), "u2", (1, 10**6))),
    "rows of lengths only": (RAGGED, claimed(ENDS, (10**9,), "i8", (10**5,))),
    "text as samples": ({}, replaced(VALUES, [[b"a"] * LENGTH] * N)),
    "one dimension": ({}, replaced(VALUES, np.zeros(N))),
    "three dimensions": ({}, replaced(VALUES, np.zeros((N, 4, 4)))),
    "another type": ({}, retyped(VALUES, "array<1>{array<1>{real}}")),
    "an unknown type": ({}, retyped(VALUES, "cube<3>{real}")),
    "encoded by name": ({}, retyped(VALUES, "array_of_encoded_equalsized_arrays<1,1>{real}")),
    "not as encoded": (VARLEN, retyped(VALUES, "array<1>{array<1>{real}}")),
    "unknown code": (VARLEN, lambda file: file[VALUES].attrs.__setitem__("codec", "x")),
    "no code": (VARLEN, lambda file: file[VALUES].attrs.__delitem__("codec")),
    "other size": (VARLEN, replaced(f"{VALUES}/decoded_size", 8)),
    "sizes without end": (VARLEN, claimed(f"{VALUES}/decoded_size", (10**9,), "i8", (1000,))),
    "huge size": (VARLEN, replaced(f"{VALUES}/decoded_size", 10**12)),
    "negative size": (VARLEN, replaced(f"{VALUES}/decoded_size", -1)),
    "size as text": (VARLEN, replaced(f"{VALUES}/decoded_size", "64")),
    "varlen too long": (VARLEN, with_bytes(CODES, 1, 0x80)),
    "varlen without end": (VARLEN, with_bytes(CODES, slice(0, 40), 0xFF)),
    "encoded lengths": (VARLEN, replaced(ENCODED_ENDS, RISING * 1000)),
    "radware other size": (RADWARE, replaced(f"{VALUES}/decoded_size", 8)),
    "radware length": (RADWARE, with_bytes(CODES, 0, 0x7F)),
    "radware section": (RADWARE, with_bytes(CODES, 2, 0x7F)),
    "radware bits": (RADWARE, with_bytes(CODES, 4, 0x7F)),
    "radware none": (RADWARE, with_bytes(CODES, slice(2, 40), 0)),
    "no period": ({}, lambda file: file.__delitem__("raw/waveform/dt")),
    "period as text": ({}, replaced("raw/waveform/dt", [b"16"] * N)),
    "no number": ({}, replaced("raw/event_number", np.full(N, np.nan))),
    "half a number": ({}, replaced("raw/event_number", np.arange(N) + 0.5)),
    "infinite number": ({}, replaced("raw/event_number", np.full(N, np.inf))),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_lh5_that_contradicts_itself(tmp_path, defect):
    options, change = DEFECTS[defect]
    path = changed(write(tmp_path / "bad.lh5", **options), change)
    tracemalloc.start()
    begun = time.monotonic()
    try:
        with pytest.raises(CpunetError, match=rf"^{re.escape(str(path))}: [^\n]+$"):
            open_pulses(path).read()
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 50e6
    assert time.monotonic() - begun < 20


def test_one_number_that_is_not_stored(tmp_path):
    change = claimed(f"{VALUES}/decoded_size", (), "i8", None)
    path = changed(write(tmp_path / "bad.lh5", **VARLEN), change)
    with pytest.raises(CpunetError, match="says it has 1 values, but not all of them are in"):
        open_pulses(path)


def test_links_in_a_circle_are_followed_once(tmp_path):
    path = tmp_path / "circle.h5"
    with h5py.File(path, "w") as file:
        file["a/b/up"] = file["/"]
        file["a/values"] = np.zeros(3)
        require_all_stored(path, file)
        file.create_dataset("a/b/missing", 3, "f4")
        with pytest.raises(CpunetError, match="/a/b/missing says it has 3 values"):
            require_all_stored(path, file)


@pytest.mark.parametrize("codec", [None, *VARLEN.values(), *RADWARE.values()])
def test_what_is_whole_is_still_read(tmp_path, codec):
    path = write(tmp_path / "good.lh5", codec=codec)
    pulses = open_pulses(path).read()
    np.testing.assert_array_equal(pulses.waveforms, waveforms())
    assert pulses.event_number.tolist() == list(range(N))


@pytest.mark.thorough
def test_every_flipped_bit_of_encoded_waveforms_is_met_or_harmless(tmp_path):
    """The compiled decoders write where these bytes tell them to."""
    for codec in (VARLEN, RADWARE):
        path = write(tmp_path / "bits.lh5", **codec)
        with h5py.File(path) as file:
            codes = file[CODES][()]
        rng = np.random.default_rng(4)
        for at in rng.integers(0, len(codes), 15):
            flipped = codes.copy()
            flipped[at] ^= np.uint8(1 << rng.integers(8))
            with h5py.File(path, "r+") as file:
                file[CODES][...] = flipped
            try:
                read = open_pulses(path).read()
            except CpunetError as error:
                met = str(error).startswith(f"{path}: event ")
            else:
                met = read.waveforms.shape == (N, LENGTH)
            assert met
        path.unlink()


def test_long_traces_come_in_small_blocks(tmp_path):
    path = tmp_path / "long.npz"
    np.savez(path, waveform=np.zeros((9, MAX_SAMPLES // 2), np.int8), dt_ns=16.0)
    source = open_pulses(path)
    assert BLOCK_BYTES // (4 * source.length) == 128
    np.savez(path, waveform=np.zeros((2, 10 * MAX_SAMPLES), np.int8), dt_ns=16.0)
    with pytest.raises(CpunetError, match="10485760 samples is no pulse"):
        open_pulses(path)


@pytest.mark.parametrize("suffix", [".lh5", ".npz", ".npy", ".fcio", ".spe", ".txt"])
def test_a_pipe_is_no_file(tmp_path, suffix):
    path = tmp_path / f"pipe{suffix}"
    os.mkfifo(path)
    with pytest.raises(CpunetError, match="is a pipe or a device, no file; copy it"):
        open_pulses(path)


def damaged_member(path: Path, at: int) -> None:
    """Flip bits within the compressed bytes of an archive's first member."""
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        info = archive.infolist()[0]
    place = info.header_offset + 60 + at
    content[place : place + 8] = b"\xff" * 8
    path.write_bytes(content)


@pytest.mark.parametrize("at", [0, 20, 200, 900])
def test_archives_with_damaged_streams(tmp_path, at):
    path = tmp_path / "bad.npz"
    np.savez_compressed(path, waveform=waveforms(), dt_ns=16.0)
    damaged_member(path, at)
    with pytest.raises(CpunetError, match=rf"^{re.escape(str(path))}: [^\n]+; [^\n]+$"):
        open_pulses(path).read()


def archive_of(path: Path, header: dict[str, object], n_bytes: int, kind: int) -> Path:
    with zipfile.ZipFile(path, "w", kind) as archive, archive.open("waveform.npy", "w") as part:
        np.lib.format.write_array_header_1_0(part, header)
        part.write(bytes(n_bytes))
    return path


@pytest.mark.parametrize(
    ("shape", "descr"),
    [
        ((10**9, 10**6), "<f8"),
        ((5, -3), "<f8"),
        ((5, 10**4), "<f8"),
        ((10**30, 1), "<f8"),
        ((5, 20), "|O"),
        ((5, 20), "<U4"),
        ((5, 20), "<M8[ns]"),
        ((5, 20), [("a", "<f4"), ("b", "<f4")]),
        ((), "<f8"),
    ],
)
@pytest.mark.parametrize("kind", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_arrays_that_are_not_what_they_say(tmp_path, shape, descr, kind):
    header = {"shape": shape, "fortran_order": False, "descr": descr}
    path = archive_of(tmp_path / "bad.npz", header, 5 * 20 * 4, kind)
    with pytest.raises(CpunetError, match=rf"^{re.escape(str(path))}: [^\n]+; [^\n]+$"):
        open_pulses(path, dt_ns=16).read()
