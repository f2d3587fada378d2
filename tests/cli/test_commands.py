"""Train, translate, validate and info on a stand with a known answer."""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stdout
from pathlib import Path

import lh5
import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure

from cpunet.cli import main
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.validation import drawings
from cpunet.validation import report as reports

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


def drawn_elsewhere(name: str) -> bool:
    """Whether another peak's figure is of the same kind; to draw one takes half a second."""
    return name.startswith(("SEP", "DEP")) and "cycle" not in name


@pytest.fixture(
    scope="module", params=["of a peak", pytest.param("all", marks=pytest.mark.slow)]
)
def report(request, trained, stand, tmp_path_factory):
    """A validation with truth, what it printed, and whether a figure was drawn."""
    out = tmp_path_factory.mktemp("report") / "report"
    words = ["validate", trained, *stand.inputs, "--out", out, "--truth", stand.truth]
    printed = io.StringIO()
    some = request.param != "all"
    with pytest.MonkeyPatch.context() as patched, redirect_stdout(printed):
        # translations of which all parameters can be determined
        patched.setattr(PositionalUNet, "forward", lambda _, pulses, **_options: pulses)
        if some:
            draw, left, every = reports._drawn, [], drawings.drawings

            def found(evaluation):
                made = every(evaluation)
                left.extend(d for name, d in made.items() if drawn_elsewhere(name))
                return made

            def drawn(drawing, advance):
                return Figure() if drawing in left else draw(drawing, advance)

            patched.setattr(drawings, "drawings", found)
            patched.setattr(reports, "_drawn", drawn)
        patched.setattr(sys, "argv", ["cpunet", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            main()
    assert stop.value.code == 0
    return out, printed.getvalue(), lambda name: not (some and drawn_elsewhere(name))


def test_metrics_have_their_schema(report, trained):
    metrics = json.loads((report[0] / "metrics.json").read_text())
    assert set(metrics["peaks"]) == {"SEP", "DEP", "FEP"}
    for scores in metrics["peaks"].values():
        counts = {"n_sim", "n_data", "not_prepared"}
        compared = {"parameters", "further", "noise", "paired", "two_sample"}
        assert counts | compared == set(scores)
        assert all(0 < n <= 24 for n in scores["not_prepared"].values())
        assert scores["n_sim"] == 24
        assert 18 <= scores["n_data"] <= 24
        assert set(scores["parameters"]) == PARAMETERS
        for comparison in scores["parameters"].values():
            # too few pulses to fit baseline methods to, but the truth needs no fit
            methods = {"raw", "ren", "truth_no_noise"}
            assert methods <= set(comparison["wasserstein"]) == set(comparison["ks"])
            assert {*comparison["wasserstein"], "ceiling"} == set(comparison["iou"])
            for value in comparison["iou"].values():
                assert 0 <= value <= 100
            for value in comparison["ks"].values():
                assert 0 <= value <= 1
            for value in comparison["wasserstein"].values():
                assert value >= 0
        assert set(scores["paired"]) == {"raw", "ren"}
        for paired in scores["paired"].values():
            assert {"rmse", "edge_rmse"} <= set(paired)
            assert 0 < paired["rmse"] < 1
            assert 0 < paired["edge_rmse"] < 1
    info = json.loads((trained / "run.json").read_text())
    assert metrics["training"]["recipe"] == "paper"
    assert metrics["training"]["device"] == info["device"]
    assert metrics["training"]["seconds"] == info["seconds"]


def test_raw_simulations_score_what_is_known_of_them(report):
    """A raw pulse does not decay; the stand's measured ones do, with 55 µs."""
    metrics = json.loads((report[0] / "metrics.json").read_text())
    for scores in metrics["peaks"].values():
        tail = scores["parameters"]["tail_slope"]
        assert tail["iou"]["raw"] == 0
        assert tail["ks"]["raw"] == 1
        assert tail["wasserstein"]["raw"] == pytest.approx(1e3 / 55, rel=0.03)
        assert scores["paired"]["raw"]["edge_rmse"] > 0.01


def test_the_report_is_complete(report):
    folder, printed, is_drawn = report
    assert listing(folder.parent) == ["report"]
    names = listing(folder)
    pictures = {name for name in names if name.endswith(".png")}
    assert set(names) - pictures == {
        ".cpunet.json",
        "metrics.json",
        "parameters.npz",
        "report.html",
    }
    expected = {f"{peak}_{p}.png" for peak in ("SEP", "DEP", "FEP") for p in PARAMETERS}
    assert expected <= pictures
    assert "losses.png" in pictures
    for cycle in ("forward_cycle", "backward_cycle"):
        assert [name for name in pictures if name.endswith(f"{cycle}.png")]
    for name in pictures:
        content = (folder / name).read_bytes()
        assert content.startswith(b"\x89PNG\r\n")
        assert len(content) > 5000 or not is_drawn(name)
    assert len([name for name in pictures if is_drawn(name)]) >= 12
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.count('<figure class="drawn') == len(pictures)
    assert "SEP" in printed
    assert str(folder / "report.html") in printed


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
