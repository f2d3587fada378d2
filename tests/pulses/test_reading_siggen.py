"""Files of siggen: spectra in Radware's format, and text."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.reading import open_pulses

PULSE = np.linspace(0, 1000, 50, dtype=np.float32)


def spectrum(rows: np.ndarray) -> bytes:
    """As siggen's `write_spectrum` lays it out: two Fortran records."""
    n_rows, length = rows.shape
    title = struct.pack("<i8siiiii", 24, b"pulse   ", length, n_rows, 1, 1, 24)
    data = rows.astype("<f4").tobytes()
    mark = struct.pack("<i", len(data))
    return title + mark + data + mark


def test_a_spectrum_is_a_pulse(tmp_path):
    path = tmp_path / "pulse.spe"
    path.write_bytes(spectrum(PULSE[np.newaxis]))
    with pytest.raises(CpunetError, match="give `dt_ns`"):
        open_pulses(path)
    source = open_pulses(path, dt_ns=1)
    assert (source.n_pulses, source.length, source.dt_ns) == (1, 50, 1)
    np.testing.assert_array_equal(source.read().waveforms, [PULSE])


def test_the_rows_of_a_spectrum_are_pulses(tmp_path):
    path = tmp_path / "pulses.spe"
    rows = np.stack([PULSE + i for i in range(5)])
    path.write_bytes(spectrum(rows))
    blocks = list(open_pulses(path, dt_ns=1).blocks(2))
    np.testing.assert_array_equal(np.concatenate([b.waveforms for b in blocks]), rows)


@pytest.mark.parametrize("cut", [40, 100, 235])
def test_a_cut_off_spectrum(tmp_path, cut):
    path = tmp_path / "pulse.spe"
    path.write_bytes(spectrum(PULSE[np.newaxis])[:cut])
    with pytest.raises(CpunetError, match=r"pulse.spe: is cut off after \d+ of 50 samples"):
        open_pulses(path, dt_ns=1)


def test_time_and_value(tmp_path):
    path = tmp_path / "pulse.txt"
    time_ns = np.arange(50) * 1.6
    np.savetxt(path, np.c_[time_ns, PULSE], header="time [ns] charge", fmt="%.2f")
    source = open_pulses(path)
    assert source.dt_ns == pytest.approx(1.6, rel=1e-3)
    np.testing.assert_allclose(source.read().waveforms[0], PULSE, atol=0.01)
    with pytest.raises(CpunetError, match="drop `dt_ns`"):
        open_pulses(path, dt_ns=16)


def test_uneven_times_are_refused(tmp_path):
    path = tmp_path / "pulse.txt"
    time_ns = np.arange(50.0)
    time_ns[30:] += 0.5
    np.savetxt(path, np.c_[time_ns, PULSE])
    with pytest.raises(CpunetError, match="no evenly rising time"):
        open_pulses(path)


@pytest.mark.parametrize("delimiter", [" ", ",", ", "])
def test_one_pulse_a_line(tmp_path, delimiter):
    path = tmp_path / "pulses.csv"
    rows = np.stack([PULSE + i for i in range(5)])
    np.savetxt(path, rows, delimiter=delimiter, comments="#", header="pulses")
    source = open_pulses(path, dt_ns=1)
    assert (source.n_pulses, source.length) == (None, 50)
    assert [len(block) for block in source.blocks(2)] == [2, 2, 1]
    np.testing.assert_array_equal(source.read().waveforms, rows)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("crystal_length: 96.0\n", r"line 1: 'crystal_length: 96.0' is no line of numbers"),
        ("# nothing\n\n", "holds no numbers"),
        ("1 2 3 4 5\n" * 4, "5 numbers are no pulse"),
        (" ".join("1" * 20) + "\n1 2\n", r"line 2: 2 numbers, before it 20"),
    ],
)
def test_other_text_is_refused(tmp_path, text, message):
    path = tmp_path / "other.txt"
    path.write_text(text)
    with pytest.raises(CpunetError, match=message):
        open_pulses(path, dt_ns=1).read()


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_comments_may_have_any_signs(tmp_path, encoding):
    path = tmp_path / "pulses.txt"
    rows = "\n".join(" ".join(f"{v:g}" for v in PULSE) for _ in range(2))
    path.write_text(f"# steps of 1 µs, ±2 %\n{rows}\n", encoding=encoding)
    source = open_pulses(path, dt_ns=1)
    np.testing.assert_allclose(source.read().waveforms, [PULSE, PULSE], rtol=1e-5)
    path.write_text(f"µ\n{rows}\n", encoding=encoding)
    with pytest.raises(CpunetError, match="of no known format"):
        open_pulses(path, dt_ns=1)
    path.write_bytes(b"#\x00\x01\n" + rows.encode())
    with pytest.raises(CpunetError, match="of no known format"):
        open_pulses(path, dt_ns=1)
