"""``cpunet simulate`` as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from cpunet.jobs.simulation.simulate import LIBRARY_FROM_HITS
from cpunet.pulses.reading import open_pulses

PPC = ["--detector", "ppc", "--set", "grid_mm=0.5"]


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch) -> None:
    monkeypatch.setenv("CPUNET_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture
def hits(tmp_path: Path) -> Path:
    path = tmp_path / "hits.npz"
    columns = {"x_mm": [10.0, 5], "y_mm": [0.0, 0], "z_mm": [20.0, 45.6]}
    np.savez(path, **columns, edep_keV=[2614.5, 100], offsets=[0, 1, 2])
    return path


def test_pulses_of_gammas(command, tmp_path: Path):
    out = tmp_path / "sim.lh5"
    words = ["--events", "FEP=4,1000-1500=2", "--dt", "10", "--length", "1500", "--out", out]
    outcome = command("simulate", *PPC, *words)
    assert outcome.code == 0
    assert "of 6 events written (" in outcome.out
    assert "of the energy lost there" in outcome.out
    assert "Simulating ppc: done" in outcome.err
    pulses = next(open_pulses(out).blocks())
    assert (pulses.dt_ns, pulses.length) == (10, 150)
    assert command("info", out).code == 0


def test_pulses_of_a_file(command, hits: Path, tmp_path: Path):
    out = tmp_path / "sim.lh5"
    coarse = tmp_path / "settings.yaml"
    coarse.write_text("library_grid_mm: 4\nlibrary_halvings: 0\n")
    words = ["--hits", hits, "--library", "--settings", coarse, "--out", out]
    outcome = command("simulate", *PPC, *words)
    assert outcome.code == 0
    assert "1 of 2 events written (1 FEP" in outcome.out
    assert "1 without any signal" in outcome.out
    assert "library pulses" in outcome.out


def test_moved_and_mirrored_hits_give_the_same_pulse(command, hits: Path, tmp_path: Path):
    moved = tmp_path / "moved.npz"
    columns = {"x_mm": [110.0], "y_mm": [0.0], "z_mm": [-20.0]}
    np.savez(moved, **columns, edep_keV=[2614.5], offsets=[0, 1])
    first, second = tmp_path / "a.lh5", tmp_path / "b.lh5"
    command("simulate", *PPC, "--hits", hits, "--out", first)
    frame = ["--origin", "100,0,0", "--flip-z"]
    command("simulate", *PPC, "--hits", moved, *frame, "--out", second)
    a, b = (next(open_pulses(path).blocks()).waveforms for path in (first, second))
    assert np.array_equal(a, b)


def test_diffusion_widens_the_edge(command, hits: Path, tmp_path: Path):
    with_, without = tmp_path / "with.lh5", tmp_path / "without.lh5"
    command("simulate", *PPC, "--hits", hits, "--out", with_)
    command("simulate", *PPC, "--hits", hits, "--no-diffusion", "--out", without)
    steepest = [
        np.diff(next(open_pulses(path).blocks()).waveforms).max() for path in (with_, without)
    ]
    assert steepest[0] < steepest[1]


def test_the_diffusion_constant_is_kept_and_widens_the_edge(
    command, hits: Path, tmp_path: Path
):
    out = tmp_path / "sim.lh5"
    steepest = {}
    for constant in ("temperature", "0.12", "siggen"):
        words = ["--hits", hits, "--dt", "1", "--diffusion-constant", constant]
        assert command("simulate", *PPC, *words, "--out", out, "--force").code == 0
        with h5py.File(out) as file:
            made = json.loads(file["geds/sim"].attrs["simulation"])
        kept = made["settings"]["diffusion_constant"]
        assert kept == (float(constant) if constant == "0.12" else constant)
        steepest[constant] = np.diff(next(open_pulses(out).blocks()).waveforms).max()
    # kT/e is 0.073 V mm/cm at 85 K; siggen counts up the cloud's duration
    assert steepest["siggen"] < steepest["0.12"] < steepest["temperature"]


def test_help_names_the_number_of_hits_that_decides(command):
    shown = " ".join(command("simulate", "--help").out.replace("│", " ").split())
    assert f"exact below {LIBRARY_FROM_HITS:,} hits" in shown


def test_a_diode_of_legend_with_its_crystal(command, hits: Path, reference_data, tmp_path):
    metadata, out = reference_data / "legend-metadata", tmp_path / "sim.lh5"
    crystal = metadata / "crystals" / "V99000.yaml"
    words = ["--detector", metadata / "diodes" / "P99000A.yaml", "--set", "grid_mm=0.5"]
    words += ["--hits", hits, "--temperature", "85", "--out", out]
    assert "give the crystal's file with --crystal" in command("simulate", *words).err
    words += ["--crystal", crystal, "--impurity-from", "depletion", "--set", "bias_V=3300"]
    outcome = command("simulate", *words)
    assert outcome.code == 0
    assert "so that it depletes at the measured 3000 V" in outcome.err
    with h5py.File(out) as file:
        made = json.loads(file["geds/sim"].attrs["simulation"])
    assert made["impurity_from"] == "depletion"
    assert made["detector"]["measured_depletion_V"] == 3000
    # simulated with the maker's impurities, P99000A would deplete at some 2260 V
    assert 1.2 < made["detector"]["impurity_scale"] < 1.5


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "give either --hits FILE or --events N"),
        (["--events", "5", "--hits", "x.npz"], "give either --hits FILE or --events N"),
        (["--events", "5", "--peak", "DPE"], "'DPE' is no known peak (FEP, SEP, DEP)"),
        (["--events", "FEP=5", "--peak", "SEP"], "leave out --peak"),
        (["--events", "FEP=5,FEP=7"], "names a peak twice; give each once"),
        (["--events", "5", "--peak", "FEP, FEP"], "names a peak twice; give each once"),
        (["--events", "FEP=5e3"], "expected FEP=N,DEP=M"),
        (["--events", "many"], "'many' is no number of events"),
        (["--events", "0"], "no event is wanted"),
        (["--events", "5", "--window-kev", "0"], "give a half-width above 0"),
        (["--events", "5", "--source-height-mm", "-1"], "not above the crystal"),
        (["--events", "5", "--dt", "1.5"], "dt_ns must be a multiple"),
        (["--events", "5", "--resolution", "1"], "expected 2 numbers"),
        (["--events", "5", "--resolution=-1,0"], "give numbers from 0 up"),
        (["--events", "5", "--set", "bias_V=900"], "does not deplete it"),
        (["--events", "5", "--temperature", "300"], "temperature_K"),
        (["--events", "5", "--diffusion-constant", "hot"], "diffusion_constant: give a number"),
        (["--events", "5", "--impurity-from", "depletion"], "no measured_depletion_V"),
        (["--events", "5", "--crystal", "x.yaml"], "leave out --crystal"),
        (["--hits", "nowhere.lh5"], "nowhere.lh5: cannot be read"),
        (["--hits", "x", "--origin", "1,2"], "--origin 1,2: expected 3 numbers"),
    ],
)
def test_wrong_words_are_one_line(command, tmp_path: Path, words: list[str], said: str):
    outcome = command("simulate", *PPC, *words, "--out", tmp_path / "sim.lh5")
    assert outcome.code == 2
    assert outcome.out == ""
    assert said in outcome.err.splitlines()[-1]
    assert "Traceback" not in outcome.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("option", "key"), [("--dt-ns", "dt_ns"), ("--length-ns", "length_ns")]
)
def test_zero_is_not_the_default_of_a_library(command, tmp_path: Path, option: str, key: str):
    outcome = command("library", "make", *PPC, option, "0", "--out", tmp_path / "psl.lh5")
    assert outcome.code == 2
    assert f"settings: {key}: " in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_unknown_detectors_list_the_known_ones(command, tmp_path: Path):
    words = ["--detector", "ipc", "--events", "5", "--out", tmp_path / "sim.lh5"]
    assert "neither a file nor one of bege, icpc, ppc" in command("simulate", *words).err


def test_columns_without_units_ask_for_the_option(command, tmp_path: Path):
    path = tmp_path / "hits.csv"
    columns = "".join(f"#column double {c}\n" for c in ("Event", "X", "Y", "Z", "Edep"))
    head = "#class tools::wcsv::ntuple\n#title hits\n#separator 44\n"
    path.write_text(f"{head}{columns}0,1,2,20,1000\n")
    out = tmp_path / "sim.lh5"
    assert "names no unit; give " in command("simulate", *PPC, "--hits", path, "--out", out).err
    units = ["--length-unit", "mm", "--energy-unit", "keV"]
    assert command("simulate", *PPC, "--hits", path, *units, "--out", out).code == 0


def test_output_is_replaced_only_when_told(command, hits: Path, tmp_path: Path):
    out = tmp_path / "sim.lh5"
    out.write_text("mine")
    words = ["simulate", *PPC, "--hits", hits, "--out", out]
    assert "exists already" in command(*words).err
    assert out.read_text() == "mine"
    assert command(*words, "--force").code == 0
