"""Which deposits are one event of a detector, however a file writes them."""

from __future__ import annotations

from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest
from lgdo import Array, Table, VectorOfVectors

from cpunet.errors import CpunetError
from cpunet.simulation.hit_description import describe_hits
from cpunet.simulation.hit_readers import hit_detectors, hit_parts, read_hits
from cpunet.simulation.hit_readers.tables import parts_of
from cpunet.simulation.hits import HitOptions

N = 12
# deposits of each Geant4 event: a decay of two steps, and one of its daughter 3 s later
EVENT = np.repeat(np.arange(N), 3)
TIME_NS = np.tile([5.0, 7.0, 3e9], N) + 1e12 * EVENT
EDEP_KEV = np.tile([1500.0, 1114.5, 238.6], N)
Z_MM = np.linspace(20, 30, 3 * N)
# what a detector sees
SEEN_KEV = [2614.5, 238.6] * N

Column = tuple[np.ndarray, str]


def remage(path: Path, columns: dict[str, Column], *, vectors: bool, table: str) -> Path:
    """A table with a row per step, or with a row per event number and time window."""
    ends = np.array([2, 3] * N).reshape(-1, 2)
    ends = (ends + 3 * np.arange(N)[:, None]).ravel()
    built = {}
    for name, (values, units) in columns.items():
        array = Array(values, attrs={"units": units} if units else {})
        built[name] = (
            VectorOfVectors(flattened_data=array, cumulative_length=Array(ends))
            if (vectors)
            else array
        )
    lh5.write(Table(col_dict=built), f"stp/{table}", path, wo_mode="overwrite_file")
    return path


def ntuple_csv(path: Path, columns: dict[str, Column]) -> Path:
    head = "#class tools::wcsv::ntuple\n#title hits\n#separator 44\n"
    head += "".join(
        f"#column double {n}_in_{u}\n" if u else f"#column int {n}\n"
        for n, (_, u) in columns.items()
    )
    rows = zip(*(values.tolist() for values, _ in columns.values()), strict=True)
    path.write_text(head + "\n".join(",".join(map(str, row)) for row in rows))
    return path


def ntuple_hdf5(path: Path, columns: dict[str, Column]) -> Path:
    with h5py.File(path, "w") as file:
        for name, (values, u) in columns.items():
            name = f"{name}_in_{u}" if u else name
            file[f"default_ntuples/det1/{name}/pages"] = values
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


LAYOUTS = ("vectors", "flat", "csv", "hdf5")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_decays_of_a_chain_are_events_of_their_own(tmp_path: Path, layout: str) -> None:
    path = written(tmp_path, layout, steps())
    hits = read_hits(path).hits
    np.testing.assert_allclose(hits.energy_kev, SEEN_KEV)
    np.testing.assert_allclose(hits.z_mm, Z_MM)
    # the first decay keeps the number of the file; no number comes twice
    assert hits.event_number[::2].tolist() == list(range(N))
    assert len(set(hits.event_number)) == 2 * N
    whole = read_hits(path, time_window_us=1e7).hits
    np.testing.assert_allclose(whole.energy_kev, 2614.5 + 238.6)
    # the steps of the first decay are 2 ns apart
    assert read_hits(path, time_window_us=1e-3).hits.n_events == 3 * N


@pytest.mark.parametrize("layout", ["vectors", "flat", "hdf5"])
def test_parts_are_the_same_events(tmp_path, monkeypatch, layout) -> None:
    path = written(tmp_path, layout, steps())
    monkeypatch.setattr(parts_of, "__defaults__", (4,))
    parts = list(hit_parts(path)())
    assert len(parts) > 2
    whole = read_hits(path).hits
    for name in ("event_number", "energy_kev", "z_mm"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name))


def test_a_description_has_the_same_events(tmp_path: Path) -> None:
    path = written(tmp_path, "flat", steps(det_uid=(np.tile([11, 11, 2], N), "")), "germanium")
    for window_us, table in ((10.0, {"2": N, "11": N}), (1e-3, {"2": N, "11": 2 * N})):
        told = describe_hits(path, HitOptions(time_window_us=window_us), {})["detectors"]
        assert {name: one["events"] for name, one in told.items()} == table


@pytest.mark.parametrize("layout", LAYOUTS)
def test_detectors_of_one_table(tmp_path: Path, layout: str) -> None:
    uid = np.tile([11, 11, 2], N)  # the daughter's gamma goes to another crystal
    path = written(tmp_path, layout, steps(det_uid=(uid, "")), "germanium")
    assert hit_detectors(path) == ["2", "11"]
    with pytest.raises(
        CpunetError, match="holds detectors 2, 11; choose one with `hits_detector`"
    ):
        read_hits(path)
    np.testing.assert_allclose(read_hits(path, detector="11").hits.energy_kev, 2614.5)
    np.testing.assert_allclose(read_hits(path, detector="2").hits.energy_kev, 238.6)


def test_detectors_by_the_names_of_their_volumes(tmp_path: Path) -> None:
    names = np.tile(["V01", "V01", "B02"], N)
    path = written(tmp_path, "csv", steps(volume=(names, "")))
    assert hit_detectors(path) == ["B02", "V01"]
    np.testing.assert_allclose(read_hits(path, detector="B02").hits.energy_kev, 238.6)


@pytest.mark.parametrize("layout", ["flat", "csv", "hdf5"])
def test_joined_jobs_number_their_events_anew(tmp_path: Path, layout: str) -> None:
    numbers = np.repeat([3, 8, 9, 2, 3, 8], [6, 6, 6, 6, 6, 6])
    path = written(tmp_path, layout, steps(evtid=(numbers, ""), time=(0 * TIME_NS, "ns")))
    hits = read_hits(path).hits
    assert np.diff(hits.offsets).tolist() == [6] * 6
    assert hits.event_number.tolist() == [3, 8, 9, 2, 10, 11]


def test_events_that_threads_wrote_in_blocks_stay_whole(tmp_path: Path) -> None:
    # two threads with even and odd events; the blocks end within 4 and 5
    numbers = np.repeat([0, 2, 4, 1, 3, 5, 4, 6, 5, 7, 8, 9], 3)
    path = written(tmp_path, "flat", steps(evtid=(numbers, ""), time=(0 * TIME_NS, "ns")))
    hits = read_hits(path).hits
    assert hits.event_number.tolist() == [0, 2, 4, 1, 3, 5, 6, 7, 8, 9]
    assert np.diff(hits.offsets).tolist() == [3, 3, 6, 3, 3, 6, 3, 3, 3, 3]


def test_rows_in_the_order_of_time_stay_together(tmp_path: Path) -> None:
    mixed = np.random.default_rng(4).permutation(3 * N)
    shuffled = {name: (values[mixed], units) for name, (values, units) in steps().items()}
    hits = read_hits(written(tmp_path, "flat", shuffled)).hits
    np.testing.assert_allclose(sorted(hits.energy_kev), sorted(SEEN_KEV))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("change", [{"edep": (EDEP_KEV, "J")}, {"time": (TIME_NS, "min")}])
def test_units_that_are_not_known_are_refused(tmp_path, layout, change) -> None:
    path = written(tmp_path, layout, steps(**change))
    with pytest.raises(CpunetError, match=r"is in '(J|min)'; expected one of"):
        read_hits(path)


@pytest.mark.parametrize(
    ("factor", "said"), [(1e-3, "up to 2.615 keV"), (1e3, "2.614e.06 keV")]
)
def test_energies_of_another_unit_are_named(tmp_path, monkeypatch, factor, said) -> None:
    path = written(tmp_path, "flat", steps(edep=(factor * EDEP_KEV, "keV")))
    with pytest.raises(CpunetError, match=rf"{said}.* correct the unit of their column"):
        read_hits(path)
    monkeypatch.setattr(parts_of, "__defaults__", (4,))
    with pytest.raises(CpunetError, match=said):
        list(hit_parts(path)())


def test_a_time_that_is_no_number_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "flat", steps(time=(np.full(3 * N, np.nan), "ns")))
    with pytest.raises(CpunetError, match="event 0: a step has no finite position or time"):
        read_hits(path)
