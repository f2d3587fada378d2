"""What is wrong with settings, in one line: of every kind, from files and words."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.errors import CpunetError
from cpunet.recipes.schema import Recipe
from cpunet.settings import Config, plain, read_json, read_settings, read_values
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.shifted import Shift

KINDS = (Electronics, Recipe, Detector, SimulationSettings, Shift)
TEXTS = {
    "a: [1\nb: 2": "not YAML .* line 2",
    "- 1": "holds no settings",
    "": "holds no settings",
    "dt_ns: 2020-99-99": "not YAML .*month",
    "a: !!python/object/apply:os.system ['true']": "not YAML .*constructor",
    "dt_nz: 3": "dt_nz: no such setting; (did you mean dt_ns|there are )|: missing",
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("text", TEXTS)
def test_unreadable_files(tmp_path: Path, kind: type[Config], text: str) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with pytest.raises(CpunetError, match=f"^{path}: [^\n]*({TEXTS[text]})[^\n]*$"):
        read_settings(kind, path)
    for place in (tmp_path, tmp_path / "none", tmp_path / ("x" * 300)):
        with pytest.raises(CpunetError, match=f"^{place}: [^\n]*$"):
            read_settings(kind, place)


def test_keys_of_parts_are_named_without_the_kind_of_the_part(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    values = read_electronics("ornl").model_dump(mode="json") | {"decays": [{"fraction": 1}]}
    path.write_text(yaml.safe_dump(values))
    with pytest.raises(CpunetError, match=r"own.yaml: decays\.0\.tau_us: missing; add it$"):
        read_settings(Electronics, path)
    path.write_text("decays: [{fraction: 1, tau: 3}]\ndt_ns: 16")
    wrong = r"decays\.0\.tau: no such setting; did you mean tau_us\?"
    with pytest.raises(CpunetError, match=wrong):
        read_settings(Electronics, path)


def test_json_and_yaml_hold_the_same(tmp_path: Path) -> None:
    values = {"dt_ns": 8, "diffusion_constant": "siggen"}
    (tmp_path / "own.json").write_text(json.dumps(values, indent="\t"))
    (tmp_path / "own.yaml").write_text("dt_ns: 8\ndiffusion_constant: siggen\n")
    assert read_values(tmp_path / "own.json") == read_values(tmp_path / "own.yaml") == values


@pytest.mark.parametrize("text", ["", "[1]", "{", "\xff"])
def test_damaged_json(tmp_path: Path, text: str) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(CpunetError, match=f"^{path}: damaged \\(.*\\); again$"):
        read_json(path, "again")


def test_values_of_numpy_are_plain() -> None:
    value = {1: np.arange(2), "b": (np.float32(0.5), np.nan, np.array([[np.inf]]), None, "c")}
    assert plain(value) == {"1": [0, 1], "b": [0.5, None, [[None]], None, "c"]}
