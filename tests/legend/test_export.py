"""A run as parameters of LEGEND's simulation chain: keys, values, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from torch import nn

from cpunet.errors import CpunetError
from cpunet.legend.export import export_legend
from cpunet.legend.make_library import make_library
from cpunet.networks.generators import ResponseGenerator
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from synthetic import write_run

MEAN = {"a": -1.5e-6, "b": 1.0024, "per_mev_percent": -0.15, "per_mev_error_percent": 0.02}
LAW = {"a": 2e-5, "b": 6.0, "c": 2.0}
METHOD = {"mean": MEAN, "resolution": LAW, "points": [], "scale": 0.08}


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recipe = load_recipe("fast", ["generator.poles_ns=[45,30]", "generator.decay_us=60"])
    generator = ResponseGenerator(recipe.matching.generator, 16.0)
    generator.response.slow_weights.data[2] = 0.03
    folder = tmp_path_factory.mktemp("chain")
    info = {"recipe": "fast", "peak": "FEP", "seed": 0, "dt_ns": 16.0}
    model = nn.ModuleDict({"ren": generator})
    write_run(folder, model, recipe, info | {"seconds": 1.0, "device": "cpu"})
    return folder


def test_a_stretched_drift_is_not_in_the_parameters(
    chain: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recipe = load_recipe("fast", ["generator.drift_terms=1"])
    generator = ResponseGenerator(recipe.matching.generator, 16.0)
    generator.response.drift.stretch.data.fill_(0.08)
    (tmp_path / "run").mkdir()
    info = json.loads((chain / "run.json").read_text())
    write_run(tmp_path / "run", nn.ModuleDict({"ren": generator}), recipe, info)
    told = export_legend(tmp_path / "run", tmp_path / "pars")
    assert any("charges drift for 8.0 % longer than simulated" in n for n in caplog.messages)
    assert told.content["electronics"]["chain"]["drift_stretch"] == pytest.approx(0.08)


def report(folder: Path, **changes: Any) -> Path:
    folder.mkdir()
    metrics = {
        "training": {"recipe": "fast", "peak": "FEP", "seed": 0},
        "ae_energy": {"multi_site": False, "methods": {"data": METHOD, "ren": METHOD}},
    }
    (folder / "metrics.json").write_text(json.dumps(metrics | changes))
    return folder


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def test_files_of_production(chain: Path, tmp_path: Path) -> None:
    out = tmp_path / "pars"
    told = export_legend(chain, out, detector="V01", report=report(tmp_path / "report"))
    assert {p.name for p in out.glob("*.yaml")} == {
        "elecmod.yaml",
        "aoemeanmod.yaml",
        "aoeresmod.yaml",
        "cpunet.yaml",
    }
    electronics = read(out / "elecmod.yaml")["V01"]
    assert set(electronics) == {"sigma", "tau"}
    assert 10 < electronics["sigma"] < 40 < electronics["tau"] < 90
    # the expressions are evaluated by production with x in keV
    mean = read(out / "aoemeanmod.yaml")["V01"]["psl"]
    assert eval(mean["expression"], {}, {"x": 1592.5} | mean["pars"]) == pytest.approx(
        1, abs=1e-4
    )
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
    assert sorted(p.name for p in out.glob("*.yaml")) == ["cpunet.yaml", "elecmod.yaml"]


def test_a_library_of_currents_is_refused(chain: Path, tmp_path: Path) -> None:
    source, time = tmp_path / "currents.lh5", np.arange(600.0)
    with h5py.File(source, "w") as file:
        library = file.create_group("V01")
        for name, values, units in (("r", [0, 1], "mm"), ("z", [0, 1], "mm"), ("dt", 1, "ns")):
            library[name] = values
            library[name].attrs["units"] = units
        library["waveform_000_deg"] = np.tile(
            np.exp(-0.5 * ((time - 300) / 30) ** 2), (2, 2, 1)
        )
    with pytest.raises(CpunetError, match="these are currents"):
        export_legend(chain, tmp_path / "pars", library=source)
    assert not (tmp_path / "pars").exists()


@pytest.mark.slow  # a library is made
def test_two_numbers_on_a_library(chain: Path, tmp_path: Path) -> None:
    detector = read_detector("ppc", ["grid_mm=0.2"])
    make_library(detector, tmp_path / "ideal.lh5", grid_mm=6, angles=(0,))
    told = export_legend(chain, tmp_path / "pars", library=tmp_path / "ideal.lh5")
    found = told.content["electronics"]["equivalent"]["of_library"]
    assert found["library"] == detector.name
    assert found["templates"] > 10
    assert 0 < found["single_site"]["rms_percent"] < 3
    assert np.isfinite(found["two_sites"]["largest_percent"])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"training": {"recipe": "fast", "peak": "SEP", "seed": 0}}, "of a run with peak SEP"),
        ({"ae_energy": {"missing": "two few events"}}, "no A/E against energy: two few"),
        ({"ae_energy": 3, "training": None}, "give the folder that `cpunet validate` made"),
        ({"ae_energy": None}, "give the folder that `cpunet validate` made"),
        (
            {"ae_energy": {"methods": {"data": METHOD}}},
            "give the folder that `cpunet validate`",
        ),
    ],
)
def test_other_reports_are_refused(
    chain: Path, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(CpunetError) as error:
        export_legend(chain, tmp_path / "pars", report=report(tmp_path / "report", **changes))
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "pars").exists()
