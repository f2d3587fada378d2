"""Written files, read by the LH5 library and by ourselves."""

from __future__ import annotations

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
from cpunet.pulses.row_columns import RowColumns, repeated
from cpunet.pulses.writing import PulseWriter, write_pulses


def some(n=6, length=20, dt_ns=16.0, start=0):
    rng = np.random.default_rng(n + start)
    return Pulses.of(
        rng.normal(size=(n, length)),
        dt_ns=dt_ns,
        energy_kev=rng.uniform(0, 3000, n),
        event_number=np.arange(start, start + n),
    )


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
    pulses = Pulses.of(waveforms, dt_ns=dt_ns, energy_kev=energy, event_number=numbers)
    blocks = (pulses[start : start + size] for start in range(0, n, size))
    columns = {"drift_time": (np.arange(n) * 1.5, "ns"), "is_valid": (numbers > 0, "")}
    assert write_pulses(path, blocks, columns=columns, t0_ns=-8.0) == n

    table = lh5.read("geds/sim", path)
    assert isinstance(table, Table)
    assert isinstance(table.waveform, WaveformTable)
    np.testing.assert_array_equal(table.waveform.values.nda, waveforms)
    assert table.waveform.values.nda.dtype == np.float32
    assert (table.waveform.dt.nda == dt_ns).all()
    assert (table.waveform.t0.nda == -8.0).all()
    assert (table.waveform.dt_units, table.waveform.t0_units) == ("ns", "ns")
    np.testing.assert_array_equal(table.energy.nda, energy)
    assert table.energy.attrs["units"] == "keV"
    np.testing.assert_array_equal(table.event_number.nda, numbers)
    np.testing.assert_array_equal(table.drift_time.nda, np.arange(n) * 1.5)
    assert table.drift_time.attrs["units"] == "ns"
    np.testing.assert_array_equal(table.is_valid.nda, numbers > 0)

    again = open_pulses(path).read()
    np.testing.assert_array_equal(again.waveforms, waveforms)
    np.testing.assert_array_equal(again.energy_kev, energy)
    np.testing.assert_array_equal(again.event_number, numbers)
    assert again.dt_ns == pytest.approx(dt_ns)


def test_dspeed_reads_a_file_buffer_by_buffer(tmp_path):
    build_dsp = pytest.importorskip("dspeed").build_dsp
    path, pulses = tmp_path / "pulses.lh5", some(20, 30)
    write_pulses(path, pulses, table="geds/raw", waveform_units="ADC", attrs={"run": "r001"})
    largest = {
        "function": "amax",
        "module": "numpy",
        "args": ["waveform", 1, "wf_max"],
        "kwargs": {"signature": "(n),()->()", "types": ["fi->f"]},
    }
    build_dsp(
        raw_in=str(path),
        dsp_out=str(tmp_path / "dsp.lh5"),
        dsp_config={"outputs": ["wf_max"], "processors": {"wf_max": largest}},
        lh5_tables=["geds/raw"],
        buffer_len=8,
        block_width=4,
    )
    (name,) = (n for n in lh5.ls(str(tmp_path / "dsp.lh5"), "geds/*") if n != "dsp_info")
    found = lh5.read(f"{name}/wf_max", str(tmp_path / "dsp.lh5")).nda
    np.testing.assert_allclose(found, pulses.waveforms.max(axis=1))


def test_a_failure_leaves_no_file(tmp_path):
    def failing():
        yield some()
        raise CpunetError("the source broke")

    with pytest.raises(CpunetError, match="the source broke"):
        write_pulses(tmp_path / "pulses.lh5", failing())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("blocks", [[], [some(0)]])
def test_no_pulses_leave_no_file(tmp_path, blocks):
    with pytest.raises(CpunetError, match=r"pulses.lh5: no pulses to write"):
        write_pulses(tmp_path / "pulses.lh5", blocks)
    assert list(tmp_path.iterdir()) == []


def test_columns_must_fit(tmp_path):
    path = tmp_path / "pulses.lh5"
    for n in (5, 7):
        with pytest.raises(CpunetError, match=r"column a has (shape|7)"):
            write_pulses(path, [some(3), some(3, start=3)], columns={"a": (np.arange(n), "")})
    with pytest.raises(CpunetError, match="column energy is the pulses' own"):
        write_pulses(path, some(), columns={"energy": (np.arange(6), "keV")})
    with PulseWriter(path) as writer:
        writer.append(some(), {"a": (np.arange(6), "")})
        with pytest.raises(CpunetError, match="separate files"):
            writer.append(some())
    assert open_pulses(path).n_pulses == 6


def test_samples_of_another_type_and_columns_of_any_kind(tmp_path):
    path = tmp_path / "pulses.lh5"
    pulses = Pulses.of(np.arange(12).reshape(4, 3) * 5000, dt_ns=16)
    hits = [[1.0], [], [2.0, 3.0], [4.0]]
    with PulseWriter(path, samples=np.uint16, waveform_units="ADC") as writer:
        for rows in (slice(0, 1), slice(1, 4)):
            column = VectorOfVectors(hits[rows], dtype=np.float64)
            writer.append(pulses[rows], others={"edep": column})
        with pytest.raises(CpunetError, match="write them to separate files"):
            writer.append(pulses)
        writer.stamp("made", "by hand")
    table = lh5.read("geds/sim", path)
    assert table.waveform.values.nda.dtype == np.uint16
    np.testing.assert_array_equal(table.waveform.values.nda, pulses.waveforms)
    assert [list(row) for row in table.edep] == hits
    with h5py.File(path) as file:
        assert file.attrs["made"] == "by hand"


def test_other_columns_are_read_by_rows(tmp_path):
    path = tmp_path / "pulses.lh5"
    columns = {"a": (np.arange(6), "mm"), "realisation": (np.arange(6), "")}
    write_pulses(path, some(), columns=columns)
    own = {"waveform", "energy", "event_number", "realisation"}
    others = RowColumns.of_hdf5(path, "geds/sim/waveform", 6, own)
    assert (others.names, others.left_out) == (
        {"a": "a", "realisation": "realisation_source"},
        {},
    )
    found = others.read(2, 3, repeats=2)
    assert found["a"].nda.tolist() == [2, 2, 3, 3, 4, 4]
    assert found["a"].attrs["units"] == "mm"
    inner = Table({"x": Array(np.arange(2)), "y": VectorOfVectors([[1], [2, 3]])})
    twice = repeated(inner, 2)
    assert twice.x.nda.tolist() == [0, 0, 1, 1]
    assert [list(row) for row in twice.y] == [[1], [1], [2, 3], [2, 3]]


def test_no_column_replaces_another(tmp_path):
    path = tmp_path / "pulses.lh5"
    names = ("rejection", "rejection_source", "scale")
    write_pulses(path, some(), columns={name: (np.full(6, len(name)), "") for name in names})
    own = {"waveform", "energy", "event_number", "rejection"}
    in_file = RowColumns.of_hdf5(path, "geds/sim/waveform", 6, own)
    beside = RowColumns.of_columns(path, open_pulses(path).columns, own)
    for others in (in_file, beside):
        values = {name: column.nda[0] for name, column in others.read(0, 6).items()}
        assert values == {"rejection_source_source": 9, "rejection_source": 16, "scale": 5}
