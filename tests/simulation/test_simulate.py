"""Simulating files: what is written, read back, counted, merged and left behind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import lh5
import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.loading import load_pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hit_files import read_hits
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulate import GammaSource, HitFile, energy_windows, simulate
from cpunet.simulation.simulator import merge_hits

SETTINGS = {"length_ns": 1600}
# in the bulk; half in the lithium layer (the top 1 mm); all in it; all outside
PLACES = [[10, 0, 20], [12, 0, 25], [5, 0, 45.5], [5, 3, 45.6], [0, 0, 300]]
HITS = Hits.of(PLACES, [1000, 600, 600, 2614.5, 500], [0, 1, 3, 4, 5], [7, 3, 20, 21])
pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def ppc() -> Detector:
    return read_detector("ppc", ["grid_mm=0.5"])


@pytest.fixture
def source(tmp_path: Path) -> HitFile:
    return HitFile(npz(tmp_path / "hits.npz", HITS))


def npz(path: Path, hits: Hits) -> Path:
    """Hits as an archive of this kind holds them: events are numbered by their rows."""
    columns = {"x_mm": hits.x_mm, "y_mm": hits.y_mm, "z_mm": hits.z_mm}
    np.savez(path, **columns, edep_keV=hits.edep_kev, offsets=hits.offsets)
    return path


def gammas(seed: int = 4) -> GammaSource:
    lines = energy_windows("FEP,SEP,DEP", load_recipe("fast").peaks, 0.5)
    wanted = dict(zip(lines, (30, 3, 3), strict=True))
    return GammaSource(wanted, height_mm=20, radius_mm=5, seed=seed)


def test_gammas_become_a_file_that_training_reads(ppc, tmp_path: Path):
    out = tmp_path / "sim.lh5"
    events = {"FEP": 30, "SEP": 3, "DEP": 3}
    summary = simulate(out, detector=ppc, events=events, settings=SETTINGS, seed=4)
    assert summary.pulses == PulseFile(out)
    n = summary.counts
    assert n["events_written"] + n["events_without_signal"] == n["events"] == 36
    assert n["hits"] < n["hits_before_merging"]
    recipe = load_recipe("fast")
    selection = parse_selection("FEP", recipe.peaks)
    used = load_pulses(PulseFile(out), "simulated", recipe, selection).prepared
    assert len(used) >= summary.lines["FEP"] > 10
    pulses = next(open_pulses(out).blocks())
    assert pulses.waveforms.shape == (n["events_written"], 100)
    assert pulses.dt_ns == 16
    assert pulses.waveforms[:, -1] == pytest.approx(1, abs=1e-3)
    assert len(np.unique(pulses.event_number)) == n["events_written"]


def test_events_do_not_depend_on_threads_but_on_the_seed(ppc, monkeypatch):
    def events(source: GammaSource) -> Hits:
        return Hits.concatenate(list(source.open(ppc).blocks))

    monkeypatch.setattr("cpunet.simulation.simulate._ROUND_EVENTS", 10)
    many = events(gammas())
    energy = np.round(many.energy_kev - 0.011, 1)
    assert [int((energy == e).sum()) for e in (2614.5, 2103.5, 1592.5)] == [30, 3, 3]
    assert np.all(np.diff(many.event_number) > 0)
    monkeypatch.setattr("cpunet.simulation.simulate._MAX_WORKERS", 1)
    assert events(gammas()).edep_kev.tolist() == many.edep_kev.tolist()
    assert events(gammas(seed=5)).edep_kev.tolist() != many.edep_kev.tolist()


def test_energy_lost_in_the_lithium_layer_is_told(ppc, source, tmp_path: Path):
    out = tmp_path / "sim.lh5"
    summary = simulate(out, detector=ppc, hits=source, settings=SETTINGS | {"cluster_mm": 0})
    # of the events with numbers 0 to 3 the last two leave no charge that moves
    assert (summary.counts["hits_outside"], summary.counts["hits_in_contacts"]) == (1, 2)
    assert "2 of 4 events written (0 FEP" in str(summary)
    assert "2 without any signal" in str(summary)
    assert summary.counts["lost_kev"] == pytest.approx(600 + 2614.5 + 500)
    table = lh5.read("geds/sim", str(out))
    assert table["energy"].nda.tolist() == [1000, 600]
    assert table["lost_energy"].nda.tolist() == [0, 600]
    assert table["lost_energy"].attrs["units"] == "keV"
    assert table["event_number"].nda.tolist() == [0, 1]
    assert table["n_hits"].nda.tolist() == [1, 2]


def test_the_file_tells_how_it_was_made_and_keeps_its_hits(ppc, source, tmp_path: Path):
    out, again = tmp_path / "sim.lh5", tmp_path / "again.lh5"
    simulate(out, detector=ppc, hits=source, settings=SETTINGS, seed=11)
    kept = read_hits(out)
    for name in ("position_mm", "edep_kev", "offsets"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(HITS[:2], name))
    assert lh5.read("geds/hits/x", str(out)).attrs["units"] == "mm"
    simulate(again, detector=ppc, hits=HitFile(out), settings=SETTINGS)
    first, second = (next(open_pulses(path).blocks()) for path in (out, again))
    assert np.array_equal(first.waveforms, second.waveforms)
    with h5py.File(out) as file:
        attributes = dict(file["geds/sim"].attrs)
    made = json.loads(attributes["simulation"])
    assert Detector.model_validate(made["detector"]) == ppc
    assert SimulationSettings.model_validate(made["settings"]) == SimulationSettings(**SETTINGS)
    assert (made["seed"], made["hits"]["file"]) == (11, str(source.path))
    assert attributes["made_by"].startswith("cpunet simulate ")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "give `hits` of a file, or `events` for the gamma Monte Carlo"),
        ({"hits": "x.npz", "events": "DPE"}, r"'DPE' is no known peak \(FEP, SEP, DEP\)"),
        ({"events": "FEP=5,FEP=7"}, "names a peak twice; give each once"),
        ({"events": "FEP=5e3"}, "'5e3' is no number of events; give N or FEP=N,DEP=M"),
        ({"events": "many"}, "`events`: 'many' is no number of events"),
        ({"events": "0"}, "no event is wanted"),
        ({"hits": "dead.npz"}, "none of 1 events gives a signal"),
        ({"settings": ["diffusion_constant=hot"]}, "diffusion_constant: give a number above 0"),
        ({"settings": ["diffusion_constant=0"]}, "diffusion_constant: give a number above 0"),
        ({"settings": ["dt_ns=1.5"]}, "dt_ns must be a multiple"),
    ],
)
def test_events_that_cannot_be_simulated(
    ppc, tmp_path: Path, monkeypatch, given: dict[str, Any], said: str
):
    monkeypatch.chdir(tmp_path)
    npz(tmp_path / "dead.npz", HITS[2:3])
    with pytest.raises(CpunetError, match=rf"^[^\n]*{said}[^\n]*$"):
        simulate("sim.lh5", detector=ppc, **{"settings": SETTINGS} | given)
    assert [file.name for file in tmp_path.iterdir()] == ["dead.npz"]


def test_merging_keeps_energy_and_stops_at_the_lithium_layer(ppc):
    # ppc's layer is 1 mm below the top at 46 mm: z = 44.99 is active, 45.01 is not
    places = [[10, 0, 44.97], [10, 0, 45.01], [10, 0, 44.99], [10, 0, 20]]
    merged = merge_hits(Hits.of(places, [100, 50, 300, 10], [0, 4, 4]), 0.05, ppc)
    assert merged.edep_kev.tolist() == [400, 10, 50]
    assert merged.z_mm == pytest.approx([44.985, 20, 45.01])
    assert merged.offsets.tolist() == [0, 3, 3]


def test_a_stray_hit_draws_no_warning_and_many_are_refused(ppc, source, tmp_path, caplog):
    def opened(inside: int, outside: int) -> str:
        caplog.clear()
        z_mm = [*(20 + 0.01 * i for i in range(inside)), *(47.0 + i for i in range(outside))]
        hits = Hits.of([[10.0, 0, z] for z in z_mm], [100.0] * len(z_mm), range(len(z_mm) + 1))
        HitFile(npz(tmp_path / "hits.npz", hits)).open(ppc)
        return " ".join(caplog.messages)

    assert opened(1000, 1) == ""
    assert opened(1000, 2) == (
        f"{source.path}: 2 of 1002 (0.2%) hits lie outside ppc (radius 34, z 0 to 46 mm); they "
        "span x 10 to 10, y 0 to 0, z 20 to 48 mm; their energy is lost; check `origin`, "
        "`flip_z` and `hits_detector`"
    )
    with pytest.raises(CpunetError, match=r"10 of 11 \(90.9%\) hits lie outside ppc .* move"):
        opened(1, 10)
