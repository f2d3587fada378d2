"""LH5 files: found by themselves, decoded, in bounded memory; written ones by its library."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from lgdo import Array, Table, VectorOfVectors, WaveformTable

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.writing import other_columns
from synthetic import waveform_table, write_pulses, write_table

RNG = np.random.default_rng(1)
N, LENGTH = 23, 40


@pytest.fixture
def raw():
    return RNG.integers(0, 60000, (N, LENGTH), dtype=np.uint16)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "pulses.lh5"


def test_a_single_table_is_read_in_blocks_whatever_the_name_of_its_file(tmp_path, raw):
    file, energy = tmp_path / "pulses.npz", RNG.uniform(0, 3000, N)
    write_table(file, "geds/raw", raw, energy, eventnumber=np.arange(N) * 7)
    source = open_pulses(file)
    assert (source.n_pulses, source.length, source.dt_ns) == (N, LENGTH, 16.0)
    blocks = list(source.blocks(5))
    assert [len(block) for block in blocks] == [5, 5, 5, 5, 3]
    pulses = Pulses.concatenate(blocks)
    np.testing.assert_array_equal(pulses.waveforms, raw)
    np.testing.assert_array_equal(pulses.energy_kev, energy)
    np.testing.assert_array_equal(pulses.event_number, np.arange(N) * 7)
    assert (source.format, source.name) == ("LH5", "geds/raw/waveform")
    assert sorted(source.columns) == ["energy", "eventnumber"]


@pytest.mark.parametrize(
    ("of_time", "dt", "of_energy", "kev"),
    [
        ("ns", 16, "keV", 1),
        ("us", 0.016, "MeV", 1000),
        ("s", 1.6e-8, "eV", 1e-3),
        ("\u03bcs", 0.016, np.array(["MeV"], h5py.string_dtype()), 1000),  # an array of one
    ],
)
def test_the_units_of_period_and_energy_count(file, raw, caplog, of_time, dt, of_energy, kev):
    energies = np.linspace(1, 2, N)
    write_table(file, "t", waveform_table(raw, dt, of_time), energies)
    with h5py.File(file, "a") as h5:
        h5["t/energy"].attrs["units"] = of_energy
    source = open_pulses(file)
    assert source.dt_ns == pytest.approx(16)
    np.testing.assert_allclose(source.read().energy_kev, kev * energies)
    corrected = open_pulses(file, kev_per_adc=0.1)  # as where a unit or a factor is wrong
    np.testing.assert_allclose(corrected.read().energy_kev, 0.1 * kev * energies)
    assert "its energies are multiplied by 0.1" in caplog.text


def test_a_column_in_adc_is_no_energy_unless_calibrated(file, raw):
    energy = Array(np.arange(N, dtype=np.uint16), attrs={"units": "ADC"})
    write_table(file, "t", raw, energy, trapE=np.arange(N) + 1.0, trapE_cal=np.arange(N) + 2.0)
    assert np.isnan(open_pulses(file).read().energy_kev).all()
    assert len(open_pulses(file).read(start=2)) == N - 2
    calibrated = open_pulses(file, kev_per_adc=0.5).read().energy_kev
    np.testing.assert_array_equal(calibrated, 0.5 * np.arange(N))
    for name, said in (
        ("energy", r"column energy is in ADC.*`kev_per_adc`"),
        ("trapE", r"column trapE is without units.*`kev_per_adc`"),
        ("nope", r"no column nope.*energy, trapE, trapE_cal"),
    ):
        with pytest.raises(CpunetError, match=said):
            open_pulses(file, energy=name)
    named = open_pulses(file, energy="trapE", kev_per_adc=2.0).read().energy_kev
    np.testing.assert_array_equal(named, 2.0 * (np.arange(N) + 1))
    in_kev = open_pulses(file, energy="trapE_cal").read().energy_kev
    np.testing.assert_array_equal(in_kev, np.arange(N) + 2)


def test_energies_of_another_file(file, tmp_path, raw):
    write_table(file, "ch1/raw", raw)
    hit = write_table(tmp_path / "hit.lh5", "ch1/hit", E_cal=np.arange(N) * 1.5)
    write_table(hit, "ch1/short", E_cal=np.arange(3.0))
    blocks = list(open_pulses(file, energy=f"{hit}:ch1/hit/E_cal").blocks(4))
    np.testing.assert_array_equal(Pulses.concatenate(blocks).energy_kev, np.arange(N) * 1.5)
    for column, said in (
        (f"{hit}:ch1/short/E_cal", rf"has 3 values for {N} waveforms"),
        (f"{hit}:ch1/hit/x", r"hit.lh5: no column ch1/hit/x; there are E_cal"),
        (f"{tmp_path / 'gone.lh5'}:ch1/hit/x", r"gone.lh5: no such file"),
    ):
        with pytest.raises(CpunetError, match=said):
            open_pulses(file, energy=column)


def test_several_tables_need_a_choice(file, raw):
    for channel in range(9):
        write_table(file, f"ch{channel}/raw", raw + np.uint16(channel))
    several = r"9 tables of waveforms \(ch0/raw, .*ch5/raw and 3 more\).*`table`"
    for table, said in ((None, several), ("ch11/raw", r"no table ch11/raw; there are ch0/raw")):
        with pytest.raises(CpunetError, match=said):
            open_pulses(file, table=table)
    for name in ("ch3/raw", "/ch3/raw/", "ch3", "ch3/raw/waveform"):
        values = open_pulses(file, table=name).read().waveforms
        np.testing.assert_array_equal(values, raw + np.uint16(3))


def test_of_several_columns_the_full_rate_is_taken_and_told(file, raw, caplog):
    caplog.set_level("INFO", "cpunet")
    presummed = waveform_table(raw[:, ::4].astype(np.uint32), 64.0)
    windowed = waveform_table(raw)
    write_table(file, "raw", waveform_presummed=presummed, waveform_windowed=windowed)
    assert open_pulses(file).name == "raw/waveform_windowed"
    (told,) = caplog.messages
    assert "waveform_windowed is read, at the full rate, not waveform_presummed" in told
    other = open_pulses(file, table="raw/waveform_presummed")
    assert (other.dt_ns, other.length) == (64.0, 10)


def test_vectors_of_their_own_lengths(file, caplog):
    """Ideal pulses, as long as their drift, stay where they end; traces are of one length."""
    caplog.set_level("INFO")
    even, odd = [[1, 2, 3, 4]] * 5, [[1, 2, 3, 4]] * 4 + [[1, 2]]
    for name, rows, kind in (("even", even, "u2"), ("odd", odd, "u2"), ("ideal", odd, "f4")):
        write_table(file, name, waveform_table(VectorOfVectors(rows, dtype=kind)))
    source = open_pulses(file, table="even")
    assert [len(b) for b in source.blocks(2)] == [2, 2, 1]
    np.testing.assert_array_equal(source.read().waveforms, even)
    with pytest.raises(CpunetError, match=r"event 4: 2 samples, others have 4; split the file"):
        open_pulses(file, table="odd").read()
    source = open_pulses(file, table="ideal")
    np.testing.assert_array_equal(source.read().waveforms, [[1, 2, 3, 4]] * 4 + [[1, 2, 2, 2]])
    np.testing.assert_array_equal(source.read(4, 5).waveforms, [[1, 2, 2, 2]])
    assert "pulses of 2 to 4 samples are continued" in caplog.text


def test_a_period_that_changes_names_the_event(file, raw):
    dt = np.full(N, 16.0)
    dt[17] = 8.0
    write_table(file, "raw", waveform_table(raw, dt), event_number=np.arange(N) + 1000)
    with pytest.raises(CpunetError, match=r"event 1017: sampling period 8 ns, before it 16 ns"):
        list(open_pulses(file).blocks(4))


def test_memory_does_not_grow_with_the_file(file):
    n, length, size = 20_000, 500, 250
    # Sixteen-bit traces of 20 MB, twice that as float32; a block needs 0.5 MB.
    write_table(file, "r", np.zeros((n, length), np.uint16))
    source = open_pulses(file)
    next(source.blocks(size))
    tracemalloc.start()
    assert sum(map(len, source.blocks(size))) == n
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e6


def test_measured_traces_with_energies_of_the_hit_tier(reference_data: Path):
    (raw_file,) = (reference_data / "real").glob("l200-p03*raw.lh5")
    (hit_file,) = (reference_data / "real").glob("l200-p03*hit.lh5")
    column = "ch1084803/hit/cuspEmax_ctc_cal"
    pulses = open_pulses(raw_file, table="ch1084803/raw", energy=f"{hit_file}:{column}").read()
    with h5py.File(hit_file) as h5:
        np.testing.assert_array_equal(pulses.energy_kev, h5[column][:])
    with h5py.File(raw_file) as h5:
        np.testing.assert_array_equal(pulses.waveforms, h5["ch1084803/raw/waveform/values"][:])
        np.testing.assert_array_equal(pulses.event_number, h5["ch1084803/raw/eventnumber"][:])


def some(n=6, length=20, dt_ns=16.0, start=0):
    rng, numbers = np.random.default_rng(n + start), np.arange(start, start + n)
    traces, energies = rng.normal(size=(n, length)), rng.uniform(0, 3000, n)
    return Pulses.of(traces, dt_ns=dt_ns, energy_kev=energies, event_number=numbers)


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    waveforms=arrays(np.float32, array_shapes(min_dims=2, max_dims=2, max_side=12)),
    dt_ns=st.floats(0.1, 1e4),
    size=st.integers(1, 12),
    data=st.data(),
)
def test_the_lh5_library_reads_what_was_written(tmp_path_factory, waveforms, dt_ns, size, data):
    path = tmp_path_factory.mktemp("round") / "pulses.lh5"
    n = len(waveforms)
    energy = data.draw(arrays(np.float64, n))
    numbers = data.draw(arrays(np.int64, n))
    given = {"energy_kev": energy, "event_number": numbers, "t0_ns": -8.0}
    pulses = Pulses.of(waveforms, dt_ns=dt_ns, **given)
    blocks = (pulses[start : start + size] for start in range(0, n, size))
    columns = {"drift_time": (np.arange(n) * 1.5, "ns"), "is_valid": (numbers > 0, "")}
    assert write_pulses(path, blocks, columns=columns) == n

    table = lh5.read("geds/sim", path)
    assert isinstance(table, Table)
    assert isinstance(table.waveform, WaveformTable)
    np.testing.assert_array_equal(table.waveform.values.nda, waveforms)
    assert table.waveform.values.nda.dtype == np.float32
    for column, values, units in (
        (table.waveform.dt, dt_ns, "ns"),
        (table.waveform.t0, -8.0, "ns"),
        (table.energy, energy, "keV"),
        (table.event_number, numbers, None),
        (table.drift_time, np.arange(n) * 1.5, "ns"),
        (table.is_valid, numbers > 0, None),
    ):
        np.testing.assert_array_equal(column.nda, np.broadcast_to(values, n))
        assert column.attrs.get("units") == units
    again = open_pulses(path).read()
    assert again.dt_ns == pytest.approx(dt_ns)
    for name in ("waveforms", *given):
        np.testing.assert_array_equal(getattr(again, name), getattr(pulses, name))


@pytest.mark.parametrize("blocks", [[], [some(0)]])
def test_no_pulses_leave_no_file(tmp_path, blocks):
    with pytest.raises(CpunetError, match=r"pulses.lh5: no pulses to write"):
        write_pulses(tmp_path / "pulses.lh5", blocks)
    assert list(tmp_path.iterdir()) == []


def test_no_column_replaces_another(tmp_path):
    names = ("rejection", "rejection_source", "scale")
    columns = {name: np.full(6, len(name)) for name in names}
    with_units = {name: (values, "") for name, values in columns.items()}
    write_pulses(tmp_path / "pulses.lh5", some(), columns=with_units)
    np.savez(tmp_path / "pulses.npz", waveform=some().waveforms, **columns)
    own = {"waveform", "energy", "event_number", "rejection"}
    for name in ("pulses.lh5", "pulses.npz"):
        read, _ = other_columns(open_pulses(tmp_path / name, dt_ns=16), own)
        values = {name: column.nda[0] for name, column in read(0, 6).items()}
        assert values == {"rejection_source_source": 9, "rejection_source": 16, "scale": 5}
