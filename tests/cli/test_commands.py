"""Train, translate, validate and info on a stand with a known answer."""

from __future__ import annotations

import json
from pathlib import Path

import lh5
import numpy as np
import pytest
import yaml

from cpunet.networks.positional_unet import PositionalUNet

PARAMETERS = {"current_amplitude", "drift_time", "tail_slope"}


def listing(folder: Path) -> list[str]:
    """Every name in a folder, hidden ones too."""
    return sorted(path.name for path in folder.iterdir())


def test_the_run_folder(trained, stand):
    assert listing(trained.parent) == ["run"]
    assert listing(trained) == [
        ".cpunet.json",
        "losses.jsonl",
        "recipe.yaml",
        "run.json",
        "weights.safetensors",
    ]
    info = json.loads((trained / "run.json").read_text())
    assert (info["recipe"], info["peak"], info["seed"]) == ("paper", "FEP", 3)
    assert info["dt_ns"] == 16
    assert info["seconds"] > 0
    for side, kev in (("sim", stand.sim_kev), ("data", stand.data_kev)):
        told = info[side]
        assert told["file"] == str(getattr(stand, side))
        assert told["read"] == len(kev)
        # every pulse is used or has a reason
        assert told["used"] + sum(told["rejections"].values()) == len(kev)
        on_peak = int((abs(kev - 2614.511) <= 5).sum())
        assert told["rejections"]["energy_outside_selection"] == len(kev) - on_peak
        assert told["used"] >= 0.8 * on_peak
    recipe = yaml.safe_load((trained / "recipe.yaml").read_text())
    assert recipe["training"]["iterations"] == 4
    lines = (trained / "losses.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    assert [record["iteration"] for record in records] == [0, 1, 2, 3]


def translated(path: Path, table: str) -> dict[str, np.ndarray]:
    columns = lh5.read(table, str(path))
    assert set(columns) == {"waveform", "energy", "event_number", "rejection"}
    waveform = columns["waveform"]
    return {
        "values": waveform["values"].nda,
        "dt": waveform["dt"].nda,
        "t0": waveform["t0"].nda,
        "dt_units": waveform["dt"].attrs["units"],
        "kev": columns["energy"].nda,
        "kev_units": columns["energy"].attrs["units"],
        "event_number": columns["event_number"].nda,
        "rejection": columns["rejection"].nda,
    }


def test_translate_keeps_the_rows(command, trained, stand, tmp_path):
    n = len(stand.sim_kev)
    outcome = command("translate", trained, stand.sim, "--out", tmp_path / "out.lh5")
    assert outcome.code == 0
    assert f"{n} of {n} pulses translated" in " ".join(outcome.out.split())
    assert listing(tmp_path) == ["out.lh5"]
    done = translated(tmp_path / "out.lh5", "geds/ren")
    assert done["values"].shape == (n, 800)
    assert done["values"].dtype == np.float32
    assert np.isfinite(done["values"]).all()
    assert (done["rejection"] == 0).all()
    assert done["event_number"].tolist() == [1000 + 3 * i for i in range(n)]
    np.testing.assert_allclose(done["kev"], stand.sim_kev)
    assert (done["dt_units"], done["kev_units"]) == ("ns", "keV")
    assert (done["dt"] == 16).all()
    assert (done["t0"] == -400 * 16).all()  # sample 400 is where the pulse is aligned


def test_raw_simulations_score_what_is_known_of_them(
    command, trained, stand, tmp_path, monkeypatch, undrawn
):
    """A raw pulse does not decay; the stand's measured ones do, with 55 µs."""
    # translations of which all parameters can be determined
    monkeypatch.setattr(PositionalUNet, "forward", lambda _, pulses, **_options: pulses)
    out = tmp_path / "report"
    words = ("validate", trained, *stand.inputs, "--truth", stand.truth, "--out", out)
    outcome = command(*words)
    assert outcome.code == 0
    assert str(out / "report.html") in outcome.out
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(metrics["peaks"]) == {"SEP", "DEP", "FEP"}
    for scores in metrics["peaks"].values():
        assert set(scores["parameters"]) == PARAMETERS
        tail = scores["parameters"]["tail_slope"]
        assert tail["iou"]["raw"] == 0
        assert tail["ks"]["raw"] == 1
        assert tail["wasserstein"]["raw"] == pytest.approx(1e3 / 55, rel=0.03)
        assert scores["paired"]["raw"]["edge_rmse"] > 0.01


def test_info_of_files_and_runs(command, stand, trained):
    told = command("info", stand.data)
    assert told.code == 0
    lines = dict(line.split(maxsplit=1) for line in told.out.splitlines())
    assert lines["traces"] == f"{len(stand.data_kev)} of 1200 samples, every 16 ns"
    assert lines["lines"] == "24 FEP, 24 SEP, 24 DEP"
    assert lines["trigger"].startswith("half of the height at sample 5")
    told = command("info", trained)
    lines = dict(line.split(maxsplit=1) for line in told.out.splitlines())
    assert lines["run"] == str(trained)
    assert lines["trained"].startswith("recipe paper on FEP, seed 3; ")
    assert "pulses used" in lines["simulated"] and "pulses used" in lines["measured"]  # noqa: PT018
    assert len(told.out.splitlines()) < 20
