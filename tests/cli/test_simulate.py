"""``cpunet simulate`` as a user calls it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

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
    words = [
        "--events",
        "FEP=4,1000-1500=2",
        "--set=dt_ns=10",
        "--set=length_ns=1500",
        "--out",
        out,
    ]
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
    words = ["--hits", hits, "--set", "mode=library", "--settings", coarse, "--out", out]
    outcome = command("simulate", *PPC, *words)
    assert outcome.code == 0
    assert "1 of 2 events written (1 FEP" in outcome.out
    assert "1 without any signal" in outcome.out
    assert "library pulses" in outcome.out


def test_a_diode_of_legend_with_its_crystal(command, hits: Path, reference_data, tmp_path):
    metadata, out, diode = (
        reference_data / "legend-metadata",
        tmp_path / "a.lh5",
        "P99000A.yaml",
    )
    shutil.copy(metadata / "diodes" / diode, tmp_path / diode)
    words = ["--detector", tmp_path / diode, "--hits", hits, "--out", out]
    for value in ("temperature_K=85", "bias_V=3300", "grid_mm=0.5", "impurity_scale=depletion"):
        words += ["--set", value]
    assert "give --set impurity_z0" in command("simulate", *words).err
    shutil.copy(metadata / "crystals" / "V99000.yaml", tmp_path / "P99000.yaml")
    outcome = command("simulate", *words)
    assert outcome.code == 0
    assert "so that it depletes at the measured 3000 V" in outcome.err
    with h5py.File(out) as file:
        made = json.loads(file["geds/sim"].attrs["simulation"])
    assert made["detector"]["measured_depletion_V"] == 3000
    # simulated with the maker's impurities, P99000A would deplete at some 2260 V
    assert 1.2 < made["detector"]["impurity_scale"] < 1.5


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "give --hits of a file, or --events for the gamma Monte Carlo"),
        (["--hits", "x.npz", "--events", "DPE"], "'DPE' is no known peak (FEP, SEP, DEP)"),
        (["--events", "FEP=5,FEP=7"], "names a peak twice; give each once"),
        (["--events", "FEP=5e3"], "'5e3' is no number of events; give N or FEP=N,DEP=M"),
        (["--events", "many"], "--events: 'many' is no number of events"),
        (["--events", "0"], "no event is wanted"),
        (["--hits", "x", "--origin", "1", "2"], "--origin"),
    ],
)
def test_wrong_words_are_one_line(command, tmp_path: Path, words: list[str], said: str):
    outcome = command("simulate", *PPC, *words, "--out", tmp_path / "sim.lh5")
    assert outcome.code == 2
    assert outcome.out == ""
    assert said in outcome.err.splitlines()[-1]
    assert "Traceback" not in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_units_and_windows_of_a_file(command, tmp_path: Path):
    path = tmp_path / "hits.csv"
    columns = "".join(f"#column double {c}\n" for c in ("Event", "X", "Y", "Z", "Edep"))
    head = "#class tools::wcsv::ntuple\n#title hits\n#separator 44\n"
    path.write_text(f"{head}{columns}0,1,2,20,1000\n1,1,2,20,400\n2,1,2,220,900\n")
    words = [*PPC, "--hits", path, "--out", tmp_path / "sim.lh5"]
    assert "names no unit; give " in command("simulate", *words).err
    units = ["--length-unit", "mm", "--energy-unit", "keV", "--events", "800-1200"]
    outcome = command("simulate", *words, *units)
    assert "1 of 2 events written (1 800-1200 by" in outcome.out
    assert "check --origin, --flip-z and --hits-detector" in outcome.err
