"""Readers of hits: real files where there are some, synthetic ones of each format."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.simulation.hit_readers import Transform, read_hits

CSV_HEAD = "#class tools::wcsv::ntuple\n#title {title}\n#separator 44\n"


def csv_file(folder: Path, columns: list[str], rows: list[str], title: str = "hits") -> Path:
    head = CSV_HEAD.format(title=title) + "".join(f"#column double {c}\n" for c in columns)
    path = folder / "hits.csv"
    path.write_text(head + "\n".join(rows))
    return path


def g4simple_file(folder: Path, **changed: object) -> Path:
    columns: dict[str, object] = {
        "event": np.array([4, 4, 7, 7, 7], np.int32),
        "volID": np.array([1, 1, 1, 2, 0], np.int32),
        "Edep": np.array([0.5, 1.0, 0.25, 0.3, 0.0]),
        "x": np.arange(5.0),
        "y": np.zeros(5),
        "z": np.array([1.0, 2, 3, 4, 5]),
    }
    columns.update(changed)
    path = folder / "hits.hdf5"
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            if values is not None:
                file[f"default_ntuples/g4sntuple/{name}/pages"] = values
    return path


def test_remage_detector_relative_to_its_origin(reference_data: Path) -> None:
    path = reference_data / "geant4" / "remage-th228-stp.lh5"
    hits = read_hits(path, detector="det1").hits
    assert (hits.n_events, len(hits.edep_kev)) == (16, 342)
    assert hits.energy_kev[0] == pytest.approx(200.0)
    assert hits.event_number[:3].tolist() == [36, 45, 106]
    assert 10 < hits.x_mm.min() < hits.x_mm.max() < 50


def test_remage_without_a_detector_names_those_there(reference_data: Path) -> None:
    path = reference_data / "geant4" / "remage-th228-stp.lh5"
    with pytest.raises(
        CpunetError, match="det1, det2, scint1, scint2; choose one with `hits_detector`"
    ):
        read_hits(path)
    with pytest.raises(CpunetError, match="no detector optdet1"):
        read_hits(path, detector="optdet1")


def test_truncated_hdf5_is_one_line(reference_data: Path, tmp_path: Path) -> None:
    whole = (reference_data / "geant4" / "remage-th228-stp.lh5").read_bytes()
    for share in (0.001, 0.3, 0.9):
        path = tmp_path / "cut.lh5"
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(CpunetError, match="truncated"):
            read_hits(path, detector="det1")


def test_geant4_csv_needs_units(reference_data: Path) -> None:
    path = reference_data / "geant4" / "single-invcoax-th228-geant4.csv"
    with pytest.raises(CpunetError, match="column X names no unit; give `length_unit`"):
        read_hits(path)
    hits = read_hits(path, length_unit="mm", energy_unit="keV").hits
    assert (hits.n_events, len(hits.edep_kev)) == (124, 1411)
    assert hits.event_number[0] == 2
    assert 2500 < hits.energy_kev.max() < 2615


def test_npz_of_geant4(reference_data: Path) -> None:
    path = reference_data / "geant4" / "g4_h20mm.npz"
    hits = read_hits(path).hits
    with np.load(path) as archive:
        np.testing.assert_allclose(hits.energy_kev, archive["event_etot_keV"], rtol=1e-5)
    assert 0 <= hits.z_mm.min() < hits.z_mm.max() <= 96


def test_g4simple_is_in_mev_and_mm(tmp_path: Path) -> None:
    read = read_hits(g4simple_file(tmp_path), detector="1")
    np.testing.assert_allclose(read.hits.energy_kev, [1500, 250])
    np.testing.assert_array_equal(read.hits.event_number, [4, 7])
    np.testing.assert_array_equal(read.hits.z_mm, [1, 2, 3])


def test_g4simple_detector_and_columns_are_checked(tmp_path: Path) -> None:
    with pytest.raises(
        CpunetError, match="holds detectors 1, 2; choose one with `hits_detector`"
    ):
        read_hits(g4simple_file(tmp_path))
    with pytest.raises(CpunetError, match="no detector 3; it holds 1, 2"):
        read_hits(g4simple_file(tmp_path), detector="3")
    with pytest.raises(CpunetError, match="has columns for event, x, y, z, edep"):
        read_hits(g4simple_file(tmp_path, Edep=None))
    with pytest.raises(CpunetError, match="differ in length"):
        read_hits(g4simple_file(tmp_path, x=np.zeros(3)), detector="1")


def test_g4simple_csv_and_bracketed_units(tmp_path: Path) -> None:
    rows = ["3,1,10,20,30", "3,0,0,0,0", "5,0.5,1,2,3"]
    plain = csv_file(tmp_path, ["event", "Edep", "x", "y", "z"], rows, title="steps data")
    read = read_hits(plain)
    np.testing.assert_allclose(read.hits.energy_kev, [1000, 500])
    assert read.steps_without_energy == 1
    named = ["event", "Edep [GeV]", "x [cm]", "y [cm]", "z [m]"]
    rows = ["3,0.001,10,20,30", "5,0.0005,1,2,3"]
    hits = read_hits(csv_file(tmp_path, named, rows)).hits
    np.testing.assert_allclose(hits.energy_kev, [1000, 500])
    np.testing.assert_allclose(hits.position_mm[0], [100, 200, 30_000])


def test_events_apart_in_the_file_are_joined(tmp_path: Path) -> None:
    rows = ["9,1,1,0,0", "2,1,2,0,0", "9,1,3,0,0"]
    path = csv_file(tmp_path, ["event", "Edep", "x", "y", "z"], rows, title="steps data")
    hits = read_hits(path).hits
    np.testing.assert_array_equal(hits.event_number, [9, 2])
    np.testing.assert_array_equal(hits.x_mm, [1, 3, 2])


def test_transform_to_the_crystal(tmp_path: Path) -> None:
    path = csv_file(
        tmp_path, ["event", "Edep", "x", "y", "z"], ["1,1,10,20,30"], title="steps data"
    )
    flipped = Transform(origin_mm=(1, 2, 50), flip_z=True)
    np.testing.assert_allclose(
        read_hits(path, transform=flipped).hits.position_mm, [[9, -18, 20]]
    )


@pytest.mark.parametrize(
    ("columns", "rows", "message"),
    [
        (["event", "x", "y", "z"], ["1,2,3,4"], "no column for edep"),
        (["event", "Edep", "x", "y", "z"], ["1,2,3,4,5", "1,2"], "is it cut off"),
        (["event", "Edep", "x", "y", "z"], ["1,2,3"], "3 values a line for 5 columns"),
        (["event", "Edep", "x", "y", "z"], [], "holds no steps"),
        (["event", "Edep", "x", "y", "z"], ["8,-2,3,4,5"], "event 8: a step"),
        (["event", "Edep", "x", "y", "z"], ["8,nan,3,4,5"], "event 8: a step"),
        (["event", "Edep", "x", "y", "z"], ["8,0,3,4,5"], "no step deposits energy"),
        (["event", "Edep [J]", "x", "y", "z"], ["8,1,3,4,5"], "is in 'J'; expected"),
    ],
)
def test_bad_csv_is_one_line(
    tmp_path: Path, columns: list[str], rows: list[str], message: str
) -> None:
    path = csv_file(tmp_path, columns, rows, title="steps data")
    with pytest.raises(CpunetError, match=message) as caught:
        read_hits(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 rubbish", b"\x89HDF\r\n\x1a\n", b"a,b"])
def test_foreign_files_are_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "foreign"
    path.write_bytes(content)
    with pytest.raises(CpunetError, match="foreign: "):
        read_hits(path)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(CpunetError, match="cannot be read"):
        read_hits(tmp_path / "none.lh5")


def test_a_detector_is_not_chosen_where_none_is_named(tmp_path: Path) -> None:
    path, x = tmp_path / "hits.npz", np.arange(3.0)
    np.savez(path, x_mm=x, y_mm=x, z_mm=x, edep_keV=x + 1, offsets=np.array([0, 3]))
    assert read_hits(path).hits.n_events == 1
    with pytest.raises(CpunetError, match="name no detector to pick V01 by; leave"):
        read_hits(path, detector="V01")
