"""The whole story on a small stand: every method is in the scores, and parts are kept."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cpunet.electronics.chain import read_electronics
from cpunet.errors import CpunetError
from cpunet.jobs.demo import demonstrate
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from synthetic import SMALL_NETWORK

TINY = (
    *SMALL_NETWORK,
    "discriminator.samples_per_step=80",
    "training.iterations=2",
    "training.decay_start=1",
    "training.batch_size=2",
    "training.log_interval=1",
    "scores.bootstraps=20",
)
RECIPE = load_recipe("paper", TINY)
EVENTS = {"FEP": 240, "SEP": 60, "DEP": 60}
BASELINE_METHODS = ("rc", "gauss_exp", "superpulse")


OPTIONS = {
    "electronics": read_electronics("legend200"),
    "detector": read_detector("ppc", ["grid_mm=0.2"]),
    "recipe": RECIPE,
    "events": EVENTS,
}


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, all_undrawn: None) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CPUNET_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A demonstration and its scores; do not change it."""
    out = tmp_path_factory.mktemp("whole") / "demo"
    return out, demonstrate(**OPTIONS, out=out)


@pytest.fixture
def interrupted(whole: tuple[Path, dict[str, Any]], tmp_path: Path) -> Path:
    """A copy that lacks its report."""
    return Path(
        shutil.copytree(whole[0], tmp_path / "demo", ignore=shutil.ignore_patterns("report"))
    )


@pytest.mark.thorough
def test_every_rival_and_the_truth_stand_beside_the_ren(
    whole: tuple[Path, dict[str, Any]],
) -> None:
    _, metrics = whole
    assert metrics["rivals"]["missing"] == {}
    assert set(metrics["rivals"]["fits"]) == set(BASELINE_METHODS)
    for peak in EVENTS:
        scores = metrics["peaks"][peak]
        iou = scores["parameters"]["current_amplitude"]["iou"]
        for method in (*BASELINE_METHODS, "truth"):
            assert {method, f"{method}_no_noise"} <= set(iou)
        assert set(scores["paired"]) == {"raw", *BASELINE_METHODS, "ren"}
        # a response fitted to the data comes nearer to the truth than none
        edges = {method: paired["edge_rmse"] for method, paired in scores["paired"].items()}
        assert max(edges[rival] for rival in BASELINE_METHODS) < edges["raw"] / 3


@pytest.mark.thorough
def test_a_quick_look_has_three_figures_and_says_what_it_is(interrupted: Path) -> None:
    demonstrate(**OPTIONS, out=interrupted, quick=True)
    report = interrupted / "report"
    drawn = {path.stem for path in report.glob("*.png")}
    assert drawn == {"SEP_mean_pulse", "SEP_current_amplitude", "SEP_single_pulse"}
    page = (report / "report.html").read_text()
    assert "This is a quick look" in page
    assert all(peak in page for peak in EVENTS)


@pytest.mark.thorough
def test_finished_parts_are_kept_and_a_whole_one_is_refused(
    whole: tuple[Path, dict[str, Any]], interrupted: Path
) -> None:
    first = whole[0] / "report" / "metrics.json"
    made = [path.stat().st_mtime_ns for path in contents(interrupted)]
    demonstrate(**OPTIONS, out=interrupted)
    kept = [path for path in contents(interrupted) if "report" not in path.parts]
    assert [path.stat().st_mtime_ns for path in kept] == made
    again = (interrupted / "report" / "metrics.json").read_text()
    assert json.loads(again) == json.loads(first.read_text())  # to the last bit
    assert again == first.read_text()
    with pytest.raises(CpunetError, match="report: exists already"):
        demonstrate(**OPTIONS, out=interrupted)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"seed": 1}, "stand: made with seed = 0, not 1"),
        ({"kind": "shifted"}, "stand: made with shift.temperature_K = none, not 2.0"),
        (
            {"electronics": read_electronics("ornl")},
            'stand: made with electronics.name = "legend200", not "ornl"',
        ),
        (
            {"detector": read_detector("ppc", ["grid_mm=0.2", "bias_V=2600"])},
            "stand: made with sim.detector.bias_V = 2500.0, not 2600.0",
        ),
        (
            {"events": {**EVENTS, "SEP": 70}},
            "stand: made with sim.hits.events.SEP = 60, not 70",
        ),
        (
            {"events": {"FEP": 240, "DEP": 60}},
            "stand: made with sim.hits.windows_kev.SEP = [2103.011, 2104.011], not none",
        ),
        (
            {"recipe": load_recipe("paper", [*TINY, "training.batch_size=3"])},
            "run: made with recipe.training.batch_size = 2, not 3",
        ),
    ],
)
def test_parts_made_with_other_options_are_not_mixed(
    interrupted: Path, changed: dict[str, Any], said: str
) -> None:
    before = contents(interrupted)
    message = refused(interrupted, **changed)
    assert message.startswith(f"{interrupted}/{said}; give --force")
    assert message.endswith("or another --out")
    assert contents(interrupted) == before


@pytest.mark.thorough
def test_the_description_of_a_recipe_does_not_matter(
    interrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cpunet.jobs.demo.validate_run", lambda *_, **__: {"kept": True})
    other = RECIPE.model_copy(update={"description": "another text"})
    assert demonstrate(**{**OPTIONS, "recipe": other}, out=interrupted) == {"kept": True}


@pytest.mark.thorough
def test_a_run_without_its_stand_is_not_taken(interrupted: Path) -> None:
    shutil.rmtree(interrupted / "stand")
    assert "run: its stand is gone" in refused(interrupted)


@pytest.mark.thorough
@pytest.mark.parametrize("text", [None, "{", "[1]", "{}"])
def test_a_damaged_stand_is_told(interrupted: Path, text: str | None) -> None:
    path = interrupted / "stand" / "stand.json"
    path.unlink()
    if text is not None:
        path.write_text(text)
    refused(interrupted)


@pytest.mark.thorough
def test_force_removes_nothing_but_what_a_demonstration_made(interrupted: Path) -> None:
    report = interrupted / "report"
    report.mkdir()
    (report / "thesis.tex").touch()
    before = contents(interrupted)
    assert "report: is no folder that cpunet validate made" in refused(interrupted, force=True)
    assert contents(interrupted) == before
    # a slip in the options is found before anything is lost
    (report / "thesis.tex").unlink()
    report.rmdir()
    before = contents(interrupted)
    assert "give at least 1 event" in refused(interrupted, force=True, events={"FEP": 0})
    assert contents(interrupted) == before


@pytest.mark.thorough
def test_force_makes_all_anew(interrupted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cpunet.jobs.demo.validate_run", lambda *_, **__: {})
    made = (interrupted / "stand" / "data.lh5").read_bytes()
    demonstrate(**OPTIONS, out=interrupted, seed=1, force=True)
    assert (interrupted / "stand" / "data.lh5").read_bytes() != made
    assert (interrupted / "run" / "run.json").exists()


def contents(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def refused(out: Path, **changed: Any) -> str:
    with pytest.raises(CpunetError) as caught:
        demonstrate(**{**OPTIONS, **changed}, out=out)
    message = str(caught.value)
    assert "\n" not in message
    return message
