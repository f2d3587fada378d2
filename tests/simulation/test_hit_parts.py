"""Steps of remage read part by part: the same hits, whatever the parts."""

from __future__ import annotations

from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest
from lgdo import Array, Table, VectorOfVectors

from cpunet.errors import CpunetError
from cpunet.simulation import hit_sources
from cpunet.simulation.energy_windows import Window
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hit_readers import hit_parts, read_hits
from cpunet.simulation.hit_readers.tables import parts_of, table_of
from cpunet.simulation.hit_sources import HitFile
from cpunet.simulation.hits import Hits

N = 53


def write(path: Path, numbers: np.ndarray, *, deposits: bool = True) -> Path:
    """Rows of one to four steps along the axis of a detector."""
    rng = np.random.default_rng(2)
    ends = np.cumsum(rng.integers(1, 5, len(numbers)))
    edep = rng.uniform(0, 900, ends[-1]) * (rng.random(ends[-1]) > 0.3) * deposits
    table = Table({"evtid": Array(numbers)})
    for axis, values in (
        ("x", 0 * edep),
        ("y", 0 * edep),
        ("z", rng.uniform(0.02, 0.03, len(edep))),
    ):
        vectors = VectorOfVectors(
            flattened_data=Array(values, attrs={"units": "m"}), cumulative_length=Array(ends)
        )
        table.add_field(f"{axis}loc", vectors)
    edeps = Array(edep, attrs={"units": "keV"})
    table.add_field(
        "edep", VectorOfVectors(flattened_data=edeps, cumulative_length=Array(ends))
    )
    lh5.write(table, "V01", str(path), group="stp", wo_mode="overwrite_file")
    return path


def require_same(a: Hits, b: Hits) -> None:
    for name in ("x_mm", "y_mm", "z_mm", "edep_kev", "offsets", "event_number"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("size", [pytest.param(1, marks=pytest.mark.thorough), 7, 52, 53, 1000])
def test_parts_hold_the_same_hits(tmp_path, monkeypatch, size, repeated):
    numbers = np.repeat(np.arange(N), 3)[:N] if repeated else 10 * np.arange(N)[::-1]
    file = write(tmp_path / "stp.lh5", numbers)
    monkeypatch.setattr("cpunet.simulation.hit_readers.tables.ROWS", size)
    monkeypatch.setattr(parts_of, "__defaults__", (size,))
    parts = hit_parts(file)
    for _ in range(2):  # as often as one likes
        found = list(parts())
        assert len(found) > 1 or size >= 52
        require_same(Hits.concatenate(found), read_hits(file).hits)


def test_event_numbers_that_differ_in_their_last_digit_only(tmp_path, monkeypatch):
    small = read_hits(write(tmp_path / "small.lh5", np.arange(N))).hits
    file = write(tmp_path / "stp.lh5", 2**53 + np.arange(N))
    read = read_hits(file).hits
    np.testing.assert_array_equal(read.event_number, 2**53 + small.event_number)
    np.testing.assert_array_equal(read.offsets, small.offsets)
    monkeypatch.setattr(parts_of, "__defaults__", (5,))
    require_same(Hits.concatenate(list(hit_parts(file)())), read)


def test_event_numbers_that_are_text(tmp_path):
    file = write(tmp_path / "stp.lh5", np.arange(N))
    with h5py.File(file, "r+") as content:
        del content["stp/V01/evtid"]
        content["stp/V01/evtid"] = [b"a"] * N
        content["stp/V01/evtid"].attrs["datatype"] = "array<1>{real}"
    with pytest.raises(CpunetError, match=r"stp\.lh5: [^\n]+$"):
        list(hit_parts(file)())


def test_rows_of_an_event_that_lie_apart_are_read_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(parts_of, "__defaults__", (5,))
    file = write(tmp_path / "stp.lh5", np.r_[np.arange(N - 1), 0])
    assert parts_of(file, table_of(file, None)) is None
    (whole,) = hit_parts(file)()
    require_same(whole, read_hits(file).hits)


def test_a_file_of_hits_gives_the_same_blocks(tmp_path, monkeypatch):
    detector = read_detector("icpc")
    file = write(tmp_path / "stp.lh5", np.arange(N))
    monkeypatch.setattr(hit_sources, "BLOCK_EVENTS", 8)
    windows = (Window("some", 100.0, 1500.0),)
    whole = [HitFile(file), HitFile(file, windows=windows)]
    expected = [(o.n_events, list(o.blocks)) for o in (one.open(detector) for one in whole)]
    monkeypatch.setattr(parts_of, "__defaults__", (5,))
    for source, (n_events, blocks) in zip(whole, expected, strict=True):
        opened = source.open(detector)
        found = list(opened.blocks)
        assert opened.n_events == n_events == sum(map(len, found))
        assert [len(block) for block in found] == [len(block) for block in blocks]
        for one, other in zip(found, blocks, strict=True):
            require_same(one, other)
    assert expected[1][0] < expected[0][0]


def test_what_is_wrong_is_told_of_parts_too(tmp_path, monkeypatch):
    monkeypatch.setattr(parts_of, "__defaults__", (5,))
    detector = read_detector("icpc")
    file = write(tmp_path / "stp.lh5", np.arange(N))
    with pytest.raises(CpunetError, match="no event in none; widen window_kev"):
        HitFile(file, windows=(Window("none", 1e6, 2e6),)).open(detector)
    with pytest.raises(CpunetError, match=r"all \d+ hits lie outside .* z 1020 to 1030 mm"):
        HitFile(file, transform=hit_sources.Transform((0.0, 0.0, -1000.0))).open(detector)
    with pytest.raises(CpunetError, match="no detector V02; it holds V01"):
        HitFile(file, "V02").open(detector)
    write(file, np.arange(N), deposits=False)
    with pytest.raises(CpunetError, match="no step deposits energy"):
        HitFile(file).open(detector)
