"""``cpunet fields`` as a user calls it."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.image import imread

COARSE = ["--set", "grid_mm=0.5"]


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch) -> None:
    monkeypatch.setenv("CPUNET_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


def test_numbers_of_a_detector(command):
    outcome = command("fields", "ppc", *COARSE)
    assert outcome.code == 0
    told = dict(line.split("  ", 1) for line in outcome.out.splitlines())
    told = {name.strip(): value.strip() for name, value in told.items()}
    # at 0.5 mm the contact is coarse; at 0.1 mm it is 2.10 pF and 1854 V
    assert 1.8 < float(told["capacitance"].split()[0]) < 2.4
    assert 1700 < float(told["depletion voltage"].split()[0]) < 2000
    assert told["bias"] == "2500 V"
    low, high = (float(told[f"{k} field"].split()[0]) for k in ("lowest", "highest"))
    assert 0 < low < 300 < 1000 < high


def test_impurities_from_the_measured_depletion(command):
    measured = ["--set", "measured_depletion_V=2200"]
    outcome = command("fields", "ppc", *COARSE, *measured, "--impurity-from", "depletion")
    assert outcome.code == 0
    told = dict(line.split("  ", 1) for line in outcome.out.splitlines())
    told = {name.strip(): value.strip() for name, value in told.items()}
    assert told["measured depletion"] == "2200 V"
    assert float(told["depletion voltage"].split()[0]) == pytest.approx(2200, abs=1)
    # given by hand, the scale leads to the same fields
    scale = ["--set", f"impurity_scale={told['impurity_scale']}"]
    again = command("fields", "ppc", *COARSE, *measured, *scale)
    assert again.out.splitlines()[1:3] == outcome.out.splitlines()[1:3]
    assert again.out.splitlines()[4] == outcome.out.splitlines()[4]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "name",
    [
        "icpc",
        pytest.param("bege", marks=pytest.mark.slow),
        pytest.param("ppc", marks=pytest.mark.slow),
    ],
)
def test_a_picture_of_each_detector(command, tmp_path: Path, name: str):
    out = tmp_path / "fields.png"
    assert command("fields", name, *COARSE, "--out", out).code == 0
    height, width = imread(out).shape[:2]
    assert width > 1200
    assert 0.3 < height / width < 1


@pytest.mark.thorough
def test_a_picture_without_paths(command, tmp_path: Path):
    out = tmp_path / "fields.svg"
    assert command("fields", "ppc", *COARSE, "--no-paths", "--out", out).code == 0
    assert out.read_text().startswith("<?xml")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["ppd"], "neither a file nor one of bege, icpc, ppc"),
        (["ppc", "--out", "x.gif"], "pictures are made as .png, .pdf, .svg"),
        (["ppc", "--set", "bias_V=900"], "does not deplete it"),
    ],
)
def test_wrong_words_are_one_line(command, words: list[str], said: str):
    outcome = command("fields", *words, *COARSE)
    assert outcome.code == 2
    assert said in outcome.err.splitlines()[-1]


def test_a_picture_is_replaced_only_when_told(command, tmp_path: Path):
    out = tmp_path / "fields.png"
    out.write_text("mine")
    assert "exists already" in command("fields", "ppc", *COARSE, "--out", out).err
    assert out.read_text() == "mine"
