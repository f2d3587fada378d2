"""The whole story on a small stand: every method is in the scores, and parts are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from cpunet.electronics.presets import read_electronics
from cpunet.errors import CpunetError
from cpunet.jobs.demo import demonstrate
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector

RECIPE = load_recipe(
    "small",
    [
        "generator.width=2",
        "discriminator.embedding_dim=2",
        "discriminator.hidden=2",
        "training.iterations=2",
        "training.decay_start=1",
        "training.batch_size=2",
        "training.statistics_batches=1",
        "training.log_interval=1",
    ],
)
EVENTS = {"FEP": 240, "SEP": 60, "DEP": 60}
RIVALS = ("rc", "gauss_exp", "superpulse")


def test_every_rival_and_the_truth_stand_beside_the_ren(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CPUNET_CACHE", str(tmp_path / "cache"))
    electronics = read_electronics("legend200")
    detector = read_detector("ppc", ["grid_mm=0.2"])
    metrics = demonstrate(electronics, detector, RECIPE, EVENTS, tmp_path / "demo")
    assert metrics["rivals"]["missing"] == {}
    assert set(metrics["rivals"]["fits"]) == set(RIVALS)
    for peak in EVENTS:
        scores = metrics["peaks"][peak]
        iou = scores["parameters"]["current_amplitude"]["iou"]
        for method in (*RIVALS, "truth"):
            assert {method, f"{method}_no_noise"} <= set(iou)
        assert set(scores["paired"]) == {"raw", *RIVALS, "ren"}
        # a response fitted to the data comes nearer to the truth than none
        edges = {method: paired["edge_rmse"] for method, paired in scores["paired"].items()}
        assert max(edges[rival] for rival in RIVALS) < edges["raw"] / 3
    stand = (tmp_path / "demo" / "stand" / "data.lh5").read_bytes()
    with pytest.raises(CpunetError, match="exists"):
        demonstrate(electronics, detector, RECIPE, EVENTS, tmp_path / "demo")
    (tmp_path / "demo" / "report").rename(tmp_path / "first")
    demonstrate(electronics, detector, RECIPE, EVENTS, tmp_path / "demo")
    assert (tmp_path / "demo" / "stand" / "data.lh5").read_bytes() == stand
    again = (tmp_path / "demo" / "report" / "metrics.json").read_bytes()
    assert again == (tmp_path / "first" / "metrics.json").read_bytes()
