"""Hits of every format: which deposits are one event; what is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from lgdo import Array, VectorOfVectors

from cpunet.errors import CpunetError
from cpunet.simulation.gammas import EnergyWindow
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hit_files import describe_hits, read_hits
from cpunet.simulation.hits import HitOptions, Hits
from cpunet.simulation.simulate import HitFile
from synthetic import one_line, write_csv, write_table

N = 12
# deposits of each Geant4 event: a decay of two steps, and one of its daughter 3 s later
EVENT = np.repeat(np.arange(N), 3)
TIME_NS = np.tile([5.0, 7.0, 3e9], N) + 1e12 * EVENT
EDEP_KEV = np.tile([1500.0, 1114.5, 238.6], N)
Z_MM = np.linspace(20, 30, 3 * N)
# what a detector sees
SEEN_KEV = [2614.5, 238.6] * N
LAYOUTS = ("vectors", "flat", "csv", "hdf5")
STEP = ["event", "Edep", "x", "y", "z"]

Column = tuple[np.ndarray, str]
JOINED = [3, 3, 8, 8, 9, 9, 2, 2, 3, 3, 8, 8]
# two threads with even and odd events; the blocks end within 4 and 5
THREADS = [0, 2, 4, 1, 3, 5, 4, 6, 5, 7, 8, 9]
GOOD = {"x_mm": [1.0, 2, 3], "y_mm": [0.0, 0, 0], "z_mm": [10.0, 20, 30]}
GOOD |= {"edep_keV": [500.0, 600, 700], "offsets": [0, 2, 3]}


def remage(path: Path, columns: dict[str, Column], *, vectors: bool, table: str) -> Path:
    """A table with a row per step, or with a row per event number and time window."""
    ends = np.array([2, 3] * N).reshape(-1, 2)
    ends = (ends + 3 * np.arange(N)[:, None]).ravel()
    built: dict[str, Any] = {}
    for name, (values, units) in columns.items():
        built[name] = Array(values, attrs={"units": units} if units else {})
        if vectors:
            flat, length = built[name], Array(ends)
            built[name] = VectorOfVectors(flattened_data=flat, cumulative_length=length)
    path.unlink(missing_ok=True)
    return write_table(path, f"stp/{table}", **built)


def ntuple_csv(path: Path, columns: dict[str, Column]) -> Path:
    names = [f"{name}_in_{unit}" if unit else name for name, (_, unit) in columns.items()]
    rows = zip(*(values.tolist() for values, _ in columns.values()), strict=True)
    return write_csv(path, names, [",".join(map(str, row)) for row in rows])


def ntuple_hdf5(path: Path, columns: dict[str, Column], table: str = "det1") -> Path:
    with h5py.File(path, "w") as file:
        for name, (values, u) in columns.items():
            name = f"{name}_in_{u}" if u else name
            file[f"default_ntuples/{table}/{name}/pages"] = values
    return path


def steps(**changed: Column) -> dict[str, Column]:
    """The columns in units that are not those of the program."""
    zero = np.zeros(3 * N)
    places = {"xloc": (zero, "m"), "yloc": (zero, "m"), "zloc": (Z_MM / 1e3, "m")}
    deposits = {"edep": (EDEP_KEV / 1e3, "MeV"), "time": (TIME_NS / 1e3, "us")}
    return {"evtid": (EVENT, ""), **deposits, **places, **changed}


def written(folder: Path, layout: str, columns: dict[str, Column], table: str = "det1") -> Path:
    if layout == "csv":
        return ntuple_csv(folder / "hits.csv", columns)
    if layout == "hdf5":
        return ntuple_hdf5(folder / "hits.hdf5", columns)
    return remage(folder / "hits.lh5", columns, vectors=layout == "vectors", table=table)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_decays_of_a_chain_are_events_of_their_own(tmp_path: Path, layout: str) -> None:
    path = written(tmp_path, layout, steps())
    hits = read_hits(path)
    np.testing.assert_allclose(hits.energy_kev, SEEN_KEV)
    np.testing.assert_allclose(hits.z_mm, Z_MM)
    # the first decay keeps the number of the file; no number comes twice
    assert hits.event_number[::2].tolist() == list(range(N))
    assert len(set(hits.event_number)) == 2 * N


def test_late_deposits_are_counted(tmp_path, caplog) -> None:
    """A third of the events has its second step 500 ns after the first."""
    for later_ns, n_events, told in ((500, 2 * N, 1), (20_500, 2 * N + N // 3, 0)):
        time = TIME_NS.copy()
        time[1::9] += later_ns  # 20 us are longer than what one event lasts
        hits = read_hits(written(tmp_path, "vectors", steps(time=(time, "ns"))))
        assert len(hits) == n_events
        assert len(caplog.messages) == told
        text = f"{N // 3} events have deposits more than 50 ns after their first"
        assert all(text in message for message in caplog.messages)
        caplog.clear()


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(
    ("columns", "detectors"),
    [
        ({"iRep": [0, 0, 4]}, ["0", "4"]),
        ({"volID": [1, 1, 1], "copyNo": [0, 0, 4]}, ["0", "4"]),
        (
            {"volID": [1, 1, 2], "iRep": [0, 5, 0]},
            ["iRep=0,volID=1", "iRep=0,volID=2", "iRep=5,volID=1"],
        ),
        ({"volID": [1, 2, 3], "iRep": [0, 0, 5]}, ["1", "2", "3"]),
        ({"det_uid": [2, 2, 11]}, ["2", "11"]),  # the daughter's gamma goes elsewhere
    ],
)
def test_volumes_and_replicas(tmp_path, layout, columns, detectors) -> None:
    of = {name: (np.tile(values, N), "") for name, values in columns.items()}
    path = written(tmp_path, layout, steps(**of), "germanium")
    assert [*describe_hits(path, {})] == detectors
    assert sum(len(read_hits(path, HitOptions(one)).edep_kev) for one in detectors) == 3 * N
    with pytest.raises(CpunetError, match=f"holds detectors {', '.join(detectors)}; choose"):
        read_hits(path)


def test_links_to_steps_of_other_files(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "all.h5", "w") as file:
        for name, factor in (("one", 1.0), ("two", 2.0)):
            columns = steps(edep=(factor * EDEP_KEV, "keV"))
            remage(tmp_path / f"{name}.lh5", columns, vectors=True, table=name)
            file[f"stp/{name}"] = h5py.ExternalLink(f"{name}.lh5", f"stp/{name}")
    one, two = (read_hits(tmp_path / "all.h5", HitOptions(name)) for name in ("one", "two"))
    np.testing.assert_allclose(two.energy_kev, 2 * one.energy_kev)
    (tmp_path / "two.lh5").unlink()
    with pytest.raises(CpunetError, match=r"two is a link to two.lh5:stp/"):
        read_hits(tmp_path / "all.h5", HitOptions("one"))


@pytest.mark.parametrize("layout", ["flat", "csv", "hdf5"])
@pytest.mark.parametrize(
    ("numbers", "events", "steps_of_event"),
    [
        (JOINED, [3, 8, 9, 2, 10, 11], [6] * 6),
        (THREADS, [0, 2, 4, 1, 3, 5, 6, 7, 8, 9], [3, 3, 6, 3, 3, 6, 3, 3, 3, 3]),
    ],
)
def test_joined_jobs_number_their_events_anew_and_threads_do_not(
    tmp_path: Path, layout: str, numbers, events, steps_of_event
) -> None:
    changed = {"evtid": (np.repeat(numbers, 3), ""), "time": (0 * TIME_NS, "ns")}
    hits = read_hits(written(tmp_path, layout, steps(**changed)))
    assert np.diff(hits.offsets).tolist() == steps_of_event
    assert hits.event_number.tolist() == events


def test_joined_csv_files_are_read_as_jobs(tmp_path: Path) -> None:
    rows = [f"{i},{i + 1},1,2,3,{name}" for i in range(4) for name in ("V1", "B")]
    alone = write_csv(tmp_path / "hits.csv", [*STEP, "volume"], rows, title="steps data")
    alone.write_text("\n".join(3 * [alone.read_text()]))
    hits = read_hits(alone, HitOptions("V1"))
    assert hits.energy_kev.tolist() == [1000, 2000, 3000, 4000] * 3
    assert len(set(hits.event_number)) == 12


def test_rows_in_the_order_of_time_stay_together(tmp_path: Path) -> None:
    mixed = np.random.default_rng(4).permutation(3 * N)
    shuffled = {name: (values[mixed], units) for name, (values, units) in steps().items()}
    hits = read_hits(written(tmp_path, "flat", shuffled))
    np.testing.assert_allclose(sorted(hits.energy_kev), sorted(SEEN_KEV))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"edep": (EDEP_KEV, "J")}, "is in 'J'; expected one of keV"),
        ({"time": (TIME_NS, "min")}, "is in 'min'; expected one of ns"),
        ({"edep": (1e-3 * EDEP_KEV, "keV")}, "up to 2.615 keV, are no deposits in germanium"),
        ({"edep": (1e3 * EDEP_KEV, "keV")}, "2.614e+06 keV, are no deposits in germanium"),
        ({"time": (np.full(3 * N, np.nan), "ns")}, "event 0: a step has no finite position or"),
        ({"evtid": (np.where(EVENT == 0, np.nan, EVENT), "")}, "column evtid"),
    ],
)
def test_wrong_columns_are_named(tmp_path: Path, change: dict[str, Column], said: str) -> None:
    path = written(tmp_path, "flat", steps(**change))
    one_line(lambda: read_hits(path), said, str(path))


def test_event_numbers_that_differ_in_their_last_digit_only(tmp_path: Path) -> None:
    small = read_hits(written(tmp_path, "vectors", steps()))
    large = read_hits(written(tmp_path, "vectors", steps(evtid=(2**53 + EVENT, ""))))
    np.testing.assert_array_equal(large.event_number, 2**53 + small.event_number)
    np.testing.assert_array_equal(large.offsets, small.offsets)


def test_damaged_files_of_remage(tmp_path: Path) -> None:
    path = written(tmp_path, "vectors", steps())
    with h5py.File(path, "r+") as file:
        file["stp/det1/xloc/cumulative_length"][0] = 1
    one_line(lambda: read_hits(path), "differ in length", str(path))
    with h5py.File(path, "r+") as file:
        del file["stp/det1/edep"]
    one_line(lambda: read_hits(path), "no table of stp or default_ntuples has columns")


def test_an_origin_in_m_of_an_array_of_one(tmp_path: Path) -> None:
    path = written(tmp_path, "vectors", steps())
    with h5py.File(path, "r+") as file:
        file["detector_origins/det1/xloc"] = np.array([0.01])
    assert (read_hits(path).x_mm == -10).all()


def test_blocks_hold_all_events_of_a_window(tmp_path, monkeypatch) -> None:
    file, detector = written(tmp_path, "vectors", steps()), read_detector("icpc")
    monkeypatch.setattr("cpunet.simulation.simulate.BLOCK_EVENTS", 8)
    hits = read_hits(file)
    low = hits[hits.energy_kev < 1500]
    for windows, expected in (((), hits), ((EnergyWindow("some", 100, 1500),), low)):
        opened = HitFile(file, windows=windows).open(detector)
        blocks = list(opened.blocks)
        assert opened.n_events == len(expected) == sum(map(len, blocks)) > 8
        assert {len(block) for block in blocks[:-1]} == {8}
        joined = Hits.concatenate(blocks)
        for name in ("position_mm", "edep_kev", "offsets", "event_number"):
            np.testing.assert_array_equal(getattr(joined, name), getattr(expected, name))
    with pytest.raises(CpunetError, match="no event in none; widen window_kev"):
        HitFile(file, windows=(EnergyWindow("none", 1e6, 2e6),)).open(detector)


def test_remage_detector_relative_to_its_origin(reference_data: Path) -> None:
    path = reference_data / "geant4" / "remage-th228-stp.lh5"
    hits = read_hits(path, HitOptions("det1"))
    assert (len(hits), len(hits.edep_kev)) == (16, 342)
    assert hits.energy_kev[0] == pytest.approx(200.0)
    assert hits.event_number[:3].tolist() == [36, 45, 106]
    assert 10 < hits.x_mm.min() < hits.x_mm.max() < 50
    with pytest.raises(CpunetError, match="no detector optdet1; it holds det1, det2, scint1"):
        read_hits(path, HitOptions("optdet1"))


def test_geant4_csv_needs_units(reference_data: Path) -> None:
    path = reference_data / "geant4" / "single-invcoax-th228-geant4.csv"
    hits = read_hits(path, HitOptions(units="keV, mm"))
    assert (len(hits), len(hits.edep_kev)) == (124, 1411)
    assert hits.event_number[0] == 2
    assert 2500 < hits.energy_kev.max() < 2615


def test_g4simple_is_in_mev_and_mm(tmp_path: Path) -> None:
    columns = {"event": [4, 4, 7, 7, 7], "volID": [1, 1, 1, 2, 0], "y": [0, 0, 0, 0, 0]}
    columns |= {"Edep": [0.5, 1, 0.25, 0.3, 0], "x": [0, 1, 2, 3, 4], "z": [1, 2, 3, 4, 5]}
    arrays = {name: (np.array(values), "") for name, values in columns.items()}
    path = ntuple_hdf5(tmp_path / "hits.hdf5", arrays, "g4sntuple")
    hits = read_hits(path, HitOptions("1"))
    np.testing.assert_allclose(hits.energy_kev, [1500, 250])
    np.testing.assert_array_equal(hits.event_number, [4, 7])
    np.testing.assert_array_equal(hits.z_mm, [1, 2, 3])
    path = ntuple_hdf5(path, arrays | {"x": (np.zeros(3), "")}, "g4sntuple")
    with pytest.raises(CpunetError, match="differ in length"):
        read_hits(path, HitOptions("1"))


def test_g4simple_csv_and_bracketed_units(tmp_path: Path) -> None:
    rows = ["3,1,10,20,30", "3,0,0,0,0", "5,0.5,1,2,3"]
    plain = write_csv(tmp_path / "hits.csv", STEP, rows, title="steps data")
    hits = read_hits(plain, HitOptions(origin=(1, 2, 50), flip_z=True))
    np.testing.assert_allclose(hits.energy_kev, [1000, 500])
    # a step without a deposit is none; y and z are turned about x
    np.testing.assert_allclose(hits.position_mm, [[9, -18, 20], [0, 0, 47]])
    named = ["event", "Edep [GeV]", "x [cm]", "y [cm]", "z [m]"]
    rows = ["3,0.001,10,20,30", "5,0.0005,1,2,3"]
    hits = read_hits(write_csv(tmp_path / "hits.csv", named, rows))
    np.testing.assert_allclose(hits.energy_kev, [1000, 500])
    np.testing.assert_allclose(hits.position_mm[0], [100, 200, 30_000])


@pytest.mark.parametrize(
    ("columns", "rows", "message"),
    [
        (["event", "x", "y", "z"], ["1,2,3,4"], "no column for edep"),
        (STEP, ["1,2,3,4,5", "1,2"], "is it cut off"),
        (STEP, ["1,2,3"], "3 values a line for 5 columns"),
        (STEP, [], "holds no steps"),
        (STEP, ["8,-2,3,4,5"], "event 8: a step"),
        (STEP, ["8,0,3,4,5"], "no step deposits energy"),
    ],
)
def test_bad_csv_is_one_line(
    tmp_path: Path, columns: list[str], rows: list[str], message: str
) -> None:
    path = write_csv(tmp_path / "hits.csv", columns, rows, title="steps data")
    one_line(lambda: read_hits(path), message, str(path))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 rubbish", b"\x89HDF\r\n\x1a\n", b"a,b"])
def test_foreign_files_are_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "foreign"
    path.write_bytes(content)
    with pytest.raises(CpunetError, match="foreign: "):
        read_hits(path)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("x_mm", [np.nan, 0, 0]),
        ("x_mm", ["1", "2", "3"]),
        ("edep_keV", [500.0, 600]),
        ("edep_keV", [-1.0, 1, 1]),
        ("offsets", [0, 1.5, 3]),
        ("offsets", [0, 3, 2]),
        ("offsets", [0, 2, 4]),
    ],
)
def test_archives(tmp_path: Path, name: str, values: list[Any]) -> None:
    path = tmp_path / "hits.npz"
    np.savez(path, **(GOOD | {name: values}))
    one_line(lambda: read_hits(path), str(path))


def test_archives_name_no_detector(tmp_path: Path) -> None:
    path = tmp_path / "hits.npz"
    np.savez(path, **(GOOD | {"offsets": np.array([0.0, 2, 3])}))
    assert read_hits(path).offsets.tolist() == [0, 2, 3]
    with pytest.raises(CpunetError, match="name no detector to pick V01 by; leave"):
        read_hits(path, HitOptions("V01"))
    with pytest.raises(CpunetError, match="cannot be read"):
        read_hits(tmp_path / "none.lh5")
