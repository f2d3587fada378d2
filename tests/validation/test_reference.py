"""From files to a report on the optional reference data; minutes each."""

from __future__ import annotations

from pathlib import Path

import pytest

from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.training.train import train
from cpunet.validation.validate import validate

pytestmark = pytest.mark.slow


@pytest.mark.timeout(1800)
def test_the_default_recipe_beats_the_raw_simulation(reference_data: Path, tmp_path: Path):
    """Trained on FEP, judged on SEP and DEP, which it has not seen."""
    folder = reference_data / "closure"
    sim, data = PulseFile(folder / "sim.lh5"), PulseFile(folder / "data.lh5")
    train(sim, data, tmp_path / "run", recipe=load_recipe("fast"), device="cpu")
    truth = folder / "truth.npz"
    metrics = validate(tmp_path / "run", sim, data, tmp_path / "report", truth=truth).metrics
    worse = []
    for peak in ("SEP", "DEP"):
        scores = metrics["peaks"][peak]
        for name, comparison in scores["parameters"].items():
            if not comparison["iou"]["ren"] > comparison["iou"]["raw"]:
                worse.append(f"{peak} {name} iou {comparison['iou']}")
            worse += [
                f"{peak} {name} {kind} {comparison[kind]}"
                for kind in ("wasserstein", "ks")
                if not comparison[kind]["ren"] < comparison[kind]["raw"]
            ]
        worse += [
            f"{peak} {kind} {scores['paired']}"
            for kind in ("rmse", "edge_rmse")
            if not scores["paired"]["ren"][kind] < scores["paired"]["raw"][kind]
        ]
    assert worse == []
    for peak, shares in (("SEP", (0.9, 0.9, 0.9)), ("DEP", (0.6, 0.9, 0.9))):
        scores = metrics["peaks"][peak]
        for (name, comparison), share in zip(scores["parameters"].items(), shares, strict=True):
            iou = comparison["iou"]
            assert iou["ren"] >= share * iou["ceiling"], (peak, name)
        assert scores["paired"]["ren"]["edge_rmse"] < 0.002
    assert metrics["peaks"]["SEP"]["two_sample"]["ren"]["auc"] < 0.65


def test_the_chain_runs_on_measured_flashcam_traces(reference_data: Path, tmp_path: Path):
    """Traces of a real detector, whose few events are taken from 300 keV on."""
    sim = PulseFile(reference_data / "closure" / "sim.lh5")
    data = PulseFile(reference_data / "real" / "th228.fcio", kev_per_adc=0.06493)
    # the simulation is of another detector, which no start of a fit would cure
    recipe = load_recipe("fast", ["training.start_factors=[1]", "training.ringing_mhz=[]"])
    made = train(sim, data, tmp_path / "run", recipe=recipe, peak="300-", device="cpu")
    assert 200 < made.data.used < 1000
    metrics = validate(tmp_path / "run", sim, data, tmp_path / "report").metrics
    scores = metrics["peaks"]["300-"]
    assert scores["n_data"] == made.data.used
    assert set(scores["parameters"]) == {"current_amplitude", "drift_time", "tail_slope"}
    for name in ("metrics.json", "report.html", "losses.png"):
        assert (tmp_path / "report" / name).is_file()
