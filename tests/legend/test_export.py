"""A run as parameters of LEGEND's chain, and two numbers in place of it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cpunet.electronics.chain import Exponentials
from cpunet.errors import CpunetError
from cpunet.legend.export import equivalent_kernel, export_legend, kernel_step
from synthetic import write_chain

MEAN = {"a": -1.5e-6, "b": 1.0024, "a_error": 2e-7, "chi_square": 3.0, "degrees": 4}
MEAN |= {"per_mev_percent": -0.15, "per_mev_error_percent": 0.02}
LAW = {"a": 2e-5, "b": 6.0, "c": 2.0}
WIDTH = LAW | {"at_reference_percent": 0.6}
METHOD = {"mean": MEAN, "resolution": WIDTH, "points": [], "scale": 0.08, "scale_error": 0.01}


def test_a_stretched_drift_is_not_in_the_parameters(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stretch = lambda chain: chain.response.drift.stretch.fill(0.08)  # noqa: E731
    run = write_chain(tmp_path / "run", "generator.drift_terms=1", change=stretch)
    told = export_legend(run, tmp_path / "pars")
    assert any("charges drift for 8.0 % longer than simulated" in n for n in caplog.messages)
    assert told.content["electronics"]["chain"]["drift_stretch"] == pytest.approx(0.08)


def report(folder: Path, **changes: Any) -> Path:
    folder.mkdir()
    training = {"recipe": "fast", "peak": "FEP", "seed": 0}
    found = {"multi_site": False, "methods": {"data": METHOD, "ren": METHOD}}
    metrics = {"peaks": {}, "training": training, "ae_energy": found}
    (folder / "metrics.json").write_text(json.dumps(metrics | changes))
    return folder


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def test_files_of_production(chain: Path, tmp_path: Path) -> None:
    out = tmp_path / "pars"
    told = export_legend(chain, out, detector="V01", report=report(tmp_path / "report"))
    always = {"elecmod", "cpunet", "response"}
    assert {path.stem for path in out.glob("*.yaml")} == always | {"aoemeanmod", "aoeresmod"}
    electronics = read(out / "elecmod.yaml")["V01"]
    assert set(electronics) == {"sigma", "tau"}
    assert 10 < electronics["sigma"] < 40 < electronics["tau"] < 90
    # the expressions are evaluated by production with x in keV
    mean = read(out / "aoemeanmod.yaml")["V01"]["psl"]
    value = eval(mean["expression"], {}, {"x": 1592.5} | mean["pars"])
    assert value == pytest.approx(1, abs=1e-4)
    width = read(out / "aoeresmod.yaml")["V01"]
    assert width == {"expression": "SigmaFit", "parameters": LAW}
    whole = read(out / "cpunet.yaml")
    assert whole == json.loads(json.dumps({told.detector: told.content}))
    assert whole["V01"]["electronics"]["chain"]["pole_1_ns"] == pytest.approx(45)
    assert whole["V01"]["electronics"]["equivalent"]["late_charge_percent"] > 0.5
    assert 40 < whole["V01"]["drift_time"]["current_maximum_delay_ns"] < 80
    with pytest.raises(CpunetError, match="exists already"):
        export_legend(chain, out)
    # without a report, what is known of A/E is nothing; old files of the kind go
    told = export_legend(chain, out, force=True)
    assert told.detector == "default"
    assert {path.stem for path in out.glob("*.yaml")} == always
    numbers = read(out / "response.yaml")["default"]["numbers"]
    head, line = (out / "response.csv").read_text().splitlines()
    row = dict(zip(head.split(","), line.split(","), strict=True))
    assert float(row["rise_10_90_ns"]) == numbers["rise_10_90_ns"]["value"]


def test_a_width_without_noise_is_not_exported(chain, tmp_path, caplog) -> None:
    silent = METHOD | {"resolution": WIDTH | {"b": 0.0}}
    found = {"multi_site": True, "methods": {"data": silent, "ren": METHOD}}
    given = report(tmp_path / "report", ae_energy=found)
    export_legend(chain, tmp_path / "pars", report=given)
    assert not (tmp_path / "pars" / "aoeresmod.yaml").exists()
    assert (tmp_path / "pars" / "aoemeanmod.yaml").exists()
    assert any("b = 0" in note for note in caplog.messages)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"training": {"recipe": "fast", "peak": "SEP", "seed": 0}}, "of a run with peak SEP"),
        ({"ae_energy": {"missing": "two few events"}}, "no A/E against energy: two few"),
        ({"ae_energy": 3}, "holds no scores by peak; give a report of cpunet validate"),
        ({"ae_energy": {}}, "no A/E against energy: give the folder that `cpunet validate`"),
        (
            {"ae_energy": {"methods": {"data": METHOD}}},
            "give the folder that `cpunet validate`",
        ),
    ],
)
def test_other_reports_are_refused(
    chain: Path, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(CpunetError, match=re.escape(words)):
        export_legend(chain, tmp_path / "pars", report=report(tmp_path / "report", **changes))
    assert not (tmp_path / "pars").exists()


def test_a_kernel_is_a_step_of_both_and_is_its_own_nearest() -> None:
    time = np.arange(-2000.0, 4000.0)
    gauss = np.exp(-0.5 * (np.arange(-600, 601) / 30.0) ** 2)
    step = np.convolve(1 - np.exp(-np.maximum(time, 0) / 90), gauss / gauss.sum(), "same")
    inner = slice(700, -700)
    np.testing.assert_allclose(kernel_step(time, 30.0, 90.0)[inner], step[inner], atol=2e-5)
    nearest = equivalent_kernel(lambda time_ns: kernel_step(time_ns, 30.0, 90.0))
    for name, value, error in (
        ("sigma_ns", 30, 0.05),
        ("tau_ns", 90, 0.1),
        ("prompt_share", 1, 1e-3),
        ("current_error_percent", 0, 0.05),
        ("late_charge_percent", 0, 1e-3),
        ("ae_error_percent", 0, 0.05),
    ):
        assert nearest[name] == pytest.approx(value, abs=error), name


def test_what_two_numbers_cannot_follow_is_told() -> None:
    fast = Exponentials.low_pass(45.0) * Exponentials.low_pass(30.0)
    slow = fast * Exponentials.low_pass(800.0, 0.06)
    without, found = (equivalent_kernel(chain.step) for chain in (fast, slow))
    # half of the slow charge is still to come when the peak is over by 500 ns
    late = "late_charge_percent"
    assert found[late] == pytest.approx(6 * np.exp(-500 / 800), abs=0.8)
    assert abs(without[late]) < 0.1
    assert found["prompt_share"] < without["prompt_share"]
    assert 40 < without["delay_ns"] < 75
