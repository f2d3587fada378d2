"""The whole story on a small stand: every method is in the scores."""

from __future__ import annotations

from pathlib import Path

import pytest

import cpunet
from cpunet import demo

PEAKS = ("FEP", "SEP", "DEP")
BASELINE_METHODS = ("rc", "gauss_exp", "superpulse")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> cpunet.Report:
    """A quick demonstration; do not change it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cpunet.demonstration.FEW", "FEP=450,SEP=60,DEP=60")
        return demo(tmp_path_factory.mktemp("whole") / "demo", quick=True)


@pytest.mark.thorough
def test_every_method_and_the_truth_stand_beside_the_ren(whole: cpunet.Report) -> None:
    metrics = whole.to_dict()
    assert metrics["baseline_methods"]["missing"] == {}
    assert set(metrics["baseline_methods"]["fits"]) == set(BASELINE_METHODS)
    for peak in PEAKS:
        scores = metrics["peaks"][peak]
        iou = scores["parameters"]["current_amplitude"]["iou"]
        for method in (*BASELINE_METHODS, "truth"):
            assert {method, f"{method}_no_noise"} <= set(iou)
        # a response fitted to the data comes nearer to the truth than none
        edges = {method: paired["edge_rmse"] for method, paired in scores["paired"].items()}
        assert max(edges[method] for method in BASELINE_METHODS) < edges["raw"] / 3
        assert edges["ren"] < edges["raw"] / 3


@pytest.mark.thorough
def test_a_quick_look_has_three_figures_and_says_what_it_is(whole: cpunet.Report) -> None:
    assert whole.folder is not None
    drawn = {path.stem for path in whole.folder.glob("*.png")}
    assert drawn == {"SEP_mean_pulse", "SEP_current_amplitude", "SEP_single_pulse"}
    page = (whole.folder / "report.html").read_text()
    assert "This is a quick look" in page
    assert all(peak in page for peak in PEAKS)


@pytest.mark.parametrize("part", ["stand", "run", "report"])
def test_an_existing_part_is_refused_before_any_work(tmp_path: Path, part: str) -> None:
    (tmp_path / part).mkdir()
    (tmp_path / part / "mine.txt").touch()
    with pytest.raises(cpunet.CpunetError, match=f"{part}: exists already"):
        demo(tmp_path)
    assert [path.name for path in tmp_path.rglob("*")] == [part, "mine.txt"]
