"""Hits with wrong values, lengths or units: one line that names the file."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest
from lgdo import Array, Table, VectorOfVectors

from cpunet.errors import CpunetError
from cpunet.simulation.clustering import cluster_hits
from cpunet.simulation.hit_readers import Transform, read_hits
from cpunet.simulation.hits import FARTHEST_MM, Hits

GOOD = {
    "x_mm": np.array([1.0, 2, 3]),
    "y_mm": np.zeros(3),
    "z_mm": np.array([10.0, 20, 30]),
    "edep_keV": np.array([500.0, 600, 700]),
    "offsets": np.array([0, 2, 3]),
}
NPZ_DEFECTS = [
    ("x_mm", np.array([np.nan, 0, 0])),
    ("x_mm", np.array(["1", "2", "3"])),
    ("edep_keV", np.array([500.0, 600])),
    ("edep_keV", np.array([-1.0, 1, 1])),
    ("offsets", np.array([0, 1.5, 3])),
    ("offsets", np.array([0, 3, 2])),
]


@pytest.mark.parametrize(("name", "values"), NPZ_DEFECTS)
def test_archives(tmp_path: Path, name: str, values: np.ndarray) -> None:
    path = tmp_path / "hits.npz"
    np.savez(path, **(GOOD | {name: values}))
    with pytest.raises(CpunetError, match=rf"^{re.escape(str(path))}: [^\n]+$"):
        read_hits(path)


def test_whole_offsets_that_are_stored_as_real_numbers(tmp_path: Path) -> None:
    path = tmp_path / "hits.npz"
    np.savez(path, **(GOOD | {"offsets": np.array([0.0, 2, 3])}))
    assert read_hits(path).hits.offsets.tolist() == [0, 2, 3]


def remage(path: Path, **changes: object) -> Path:
    rows = [[1.0, 2], [3.0]]
    columns: dict[str, object] = {
        "evtid": Array(np.array([3, 7])),
        "edep": VectorOfVectors([[500.0, 600], [700.0]], attrs={"units": "keV"}),
        **{f"{axis}loc": VectorOfVectors(rows, attrs={"units": "mm"}) for axis in "xyz"},
    }
    lh5.write(Table(col_dict=columns | changes), "stp/det1", path)
    return path


@pytest.mark.parametrize(
    "change",
    [
        {"xloc": VectorOfVectors([[1.0], [2.0, 3]], attrs={"units": "mm"})},
        {"evtid": Array(np.array([3, np.nan]))},
        {"zloc": VectorOfVectors([[1.0, 2], [3.0]], attrs={"units": "mile"})},
    ],
)
def test_remage_tables(tmp_path: Path, change: dict[str, object]) -> None:
    path = remage(tmp_path / "stp.lh5", **change)
    with pytest.raises(CpunetError, match=rf"^{re.escape(str(path))}: [^\n]+$"):
        read_hits(path)


@pytest.mark.parametrize("origin", [0.01, np.array([0.01])])
def test_an_origin_is_a_number_or_an_array_of_one(tmp_path: Path, origin: object) -> None:
    path = remage(tmp_path / "stp.lh5")
    with h5py.File(path, "r+") as file:
        file["detector_origins/det1/xloc"] = origin  # in m
        file["detector_origins/det1/yloc"] = file["detector_origins/det1/zloc"] = 0.0
    assert read_hits(path).hits.x_mm.tolist() == [-9, -8, -7]


def test_a_file_of_remage_without_steps(tmp_path: Path) -> None:
    path = remage(tmp_path / "stp.lh5")
    with h5py.File(path, "r+") as file:
        del file["stp/det1/edep"]
    with pytest.raises(CpunetError, match="no table of stp or default_ntuples has columns"):
        read_hits(path)


def test_stored_hits_of_other_events(tmp_path: Path) -> None:
    path = tmp_path / "sim.lh5"
    with h5py.File(path, "w") as file:
        file["geds/hits/event_number"] = [1, 1, 2]
        for name, units in (("x", "mm"), ("y", "mm"), ("z", "mm"), ("edep", "keV")):
            file[f"geds/hits/{name}"] = np.full(3, 10.0)
            file[f"geds/hits/{name}"].attrs["units"] = units
        file["geds/sim/event_number"] = [1, 2, 3]
    with pytest.raises(CpunetError, match="geds/hits has no hit of event 3"):
        read_hits(path)


def test_an_origin_that_is_far_away(tmp_path: Path) -> None:
    path = tmp_path / "hits.npz"
    np.savez(path, **GOOD)
    with pytest.raises(CpunetError, match="check the units and the origin"):
        read_hits(path, transform=Transform((1e300, 0, 0)))


def test_hits_at_the_edge_of_what_is_allowed_are_merged() -> None:
    places = [[FARTHEST_MM, 0, 0], [-FARTHEST_MM, 0, 0]]
    assert cluster_hits(Hits.of(places, [1.0, 1.0], [0, 2]), 0.05).n_events == 1
