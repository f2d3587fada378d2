"""Hits that no simulation writes: one line that names the file, and never a crash."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lgdo import Array, Table, VectorOfVectors

from cpunet.errors import CpunetError
from cpunet.simulation.clustering import cluster_hits
from cpunet.simulation.hit_readers import Transform, read_hits
from cpunet.simulation.hits import FARTHEST_MM, Hits
from cpunet.simulation.signals import hit_table

GOOD = {
    "x_mm": np.array([1.0, 2, 3]),
    "y_mm": np.zeros(3),
    "z_mm": np.array([10.0, 20, 30]),
    "edep_keV": np.array([500.0, 600, 700]),
    "offsets": np.array([0, 2, 3]),
}

# array → (what it is changed to)
NPZ_DEFECTS = {
    "far": ("x_mm", np.array([1.0, 1e300, 3])),
    "far away": ("z_mm", np.array([1.0, -1e9, 3])),
    "infinite": ("y_mm", np.array([np.inf, 0, 0])),
    "nan": ("x_mm", np.array([np.nan, 0, 0])),
    "text": ("x_mm", np.array(["1", "2", "3"])),
    "complex": ("x_mm", np.array([1j, 2, 3])),
    "two dimensions": ("x_mm", np.zeros((3, 1))),
    "scalar": ("x_mm", np.array(1.0)),
    "short": ("edep_keV", np.array([500.0, 600])),
    "energy": ("edep_keV", np.array([1e300, 1, 1])),
    "negative energy": ("edep_keV", np.array([-1.0, 1, 1])),
    "half offsets": ("offsets", np.array([0, 1.5, 3])),
    "nan offsets": ("offsets", np.array([0, np.nan, 3])),
    "text offsets": ("offsets", np.array(["0", "2", "3"])),
    "huge offsets": ("offsets", np.array([0, 2**62, 3])),
    "unsigned offsets": ("offsets", np.array([0, 2**63 + 5, 3], np.uint64)),
    "no offsets": ("offsets", np.array([], int)),
    "falling offsets": ("offsets", np.array([0, 3, 2])),
    "dates": ("offsets", np.array([0, 2, 3], "M8[ns]")),
}


@pytest.mark.parametrize("defect", NPZ_DEFECTS)
def test_archives_that_hold_no_hits(tmp_path: Path, defect: str) -> None:
    name, values = NPZ_DEFECTS[defect]
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


REMAGE_DEFECTS = {
    "other division": {"xloc": VectorOfVectors([[1.0], [2.0, 3]], attrs={"units": "mm"})},
    "nan number": {"evtid": Array(np.array([3, np.nan]))},
    "infinite number": {"evtid": Array(np.array([3, np.inf]))},
    "far": {"zloc": VectorOfVectors([[1e300, 2], [3.0]], attrs={"units": "mm"})},
    "units": {"zloc": VectorOfVectors([[1.0, 2], [3.0]], attrs={"units": "mile"})},
}


@pytest.mark.parametrize("defect", REMAGE_DEFECTS)
def test_remage_tables_that_contradict_themselves(tmp_path: Path, defect: str) -> None:
    path = remage(tmp_path / "stp.lh5", **REMAGE_DEFECTS[defect])
    with pytest.raises(CpunetError, match=rf"^{re.escape(str(path))}: [^\n]+$"):
        read_hits(path)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("edep/cumulative_length", [2]),
        ("edep/cumulative_length", [2, 1]),
        ("edep/cumulative_length", [2, 9]),
        ("edep/cumulative_length", [-1, 3]),
        ("edep/flattened_data", [1.0]),
        ("edep/flattened_data", [b"a", b"b", b"c"]),
        ("evtid", [3]),
    ],
)
def test_remage_tables_shorter_than_their_events(tmp_path, name, values) -> None:
    path = remage(tmp_path / "stp.lh5")
    assert read_hits(path).hits.event_number.tolist() == [3, 7]
    with h5py.File(path, "r+") as file:
        old = file[f"stp/det1/{name}"]
        attributes = dict(old.attrs)
        del file[f"stp/det1/{name}"]
        file[f"stp/det1/{name}"] = values
        file[f"stp/det1/{name}"].attrs.update(attributes)
    with pytest.raises(CpunetError, match=rf"^{re.escape(str(path))}: [^\n]+$"):
        read_hits(path)


@pytest.mark.parametrize("origin", [0.01, np.array([0.01])])
def test_an_origin_is_a_number_or_an_array_of_one(tmp_path: Path, origin: object) -> None:
    path = remage(tmp_path / "stp.lh5")
    with h5py.File(path, "r+") as file:
        file["detector_origins/det1/xloc"] = origin  # in m
        file["detector_origins/det1/yloc"] = file["detector_origins/det1/zloc"] = 0.0
    assert read_hits(path).hits.x_mm.tolist() == [-9, -8, -7]


@pytest.mark.parametrize("origin", [[1j], [b"far"], [0.0, 0.0]])
def test_an_origin_that_is_no_number(tmp_path: Path, origin: object) -> None:
    path = remage(tmp_path / "stp.lh5")
    with h5py.File(path, "r+") as file:
        file["detector_origins/det1/xloc"] = origin
    with pytest.raises(CpunetError, match="detector_origins/det1/xloc is no number"):
        read_hits(path)


def test_a_file_of_remage_without_steps(tmp_path: Path) -> None:
    path = remage(tmp_path / "stp.lh5")
    with h5py.File(path, "r+") as file:
        del file["stp/det1/edep"]
    with pytest.raises(CpunetError, match="no table of stp has edep, xloc, yloc, zloc"):
        read_hits(path)
    with pytest.raises(CpunetError, match="no detector det1; it holds none"):
        read_hits(path, detector="det1")


def kept(path: Path, numbers: object, pulses: object) -> Path:
    n = len(np.atleast_1d(numbers))
    with h5py.File(path, "w") as file:
        file["geds/hits/event_number"] = numbers
        for name, units in (("x", "mm"), ("y", "mm"), ("z", "mm"), ("edep", "keV")):
            file[f"geds/hits/{name}"] = np.full(n, 10.0)
            file[f"geds/hits/{name}"].attrs["units"] = units
        file["geds/sim/event_number"] = pulses
    return path


@pytest.mark.parametrize(
    ("numbers", "pulses", "part"),
    [
        ([1, 1, 2], [1, 2, 3], "geds/hits has no hit of event 3"),
        ([1.0, np.nan, 2], [1, 2], "no whole number"),
        ([b"1", b"2", b"3"], [1, 2], "holds no numbers"),
    ],
)
def test_kept_hits_of_other_events(tmp_path: Path, numbers, pulses, part) -> None:
    path = kept(tmp_path / "sim.lh5", numbers, pulses)
    with pytest.raises(CpunetError, match=part):
        read_hits(path)


@pytest.mark.parametrize("detector", ["²", "--1", "1e3", "nan", ""])
def test_detectors_that_are_no_numbers(tmp_path: Path, detector: str) -> None:
    path = tmp_path / "hits.hdf5"
    with h5py.File(path, "w") as file:
        for name in ("event", "volID", "Edep", "x", "y", "z"):
            file[f"default_ntuples/g4sntuple/{name}/pages"] = np.ones(3)
    with pytest.raises(CpunetError, match=f"no detector {detector}; it holds 1"):
        read_hits(path, detector=detector)
    with h5py.File(path, "r+") as file:
        file["default_ntuples/g4sntuple/volID/pages"][1] = np.nan
    with pytest.raises(CpunetError, match=r"no whole number"):
        read_hits(path)


def test_an_origin_that_is_far_away(tmp_path: Path) -> None:
    path = tmp_path / "hits.npz"
    np.savez(path, **GOOD)
    with pytest.raises(CpunetError, match="check the units and the origin"):
        read_hits(path, transform=Transform((1e300, 0, 0)))


@given(st.floats(min_value=FARTHEST_MM, exclude_min=True, allow_nan=False))
def test_compiled_loops_see_no_hit_that_is_far_away(far: float) -> None:
    with pytest.raises(CpunetError):
        Hits.of([[far, 0, 0]], [1.0], [0, 1])
    with pytest.raises(CpunetError):
        hit_table(far, 0.0, 0.0, 1.0)


def test_hits_at_the_edge_of_what_is_allowed_are_merged() -> None:
    places = [[FARTHEST_MM, 0, 0], [-FARTHEST_MM, 0, 0]]
    assert cluster_hits(Hits.of(places, [1.0, 1.0], [0, 2]), 0.05).n_events == 1
