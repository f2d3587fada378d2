"""Settings of every kind: what is wrong in one line; recipes: the paper's numbers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.errors import CpunetError
from cpunet.recipes import list_recipes, load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.settings import (
    Config,
    checked,
    key_values,
    plain,
    read_json,
    read_settings,
    read_values,
    yaml_text,
)
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import (
    Shift,
    SimulationSettings,
    detector_and_settings,
    read_detector,
)
from synthetic import one_line

KINDS = (Electronics, Recipe, Detector, SimulationSettings, Shift)
TEXTS = {
    "a: [1\nb: 2": "not YAML .* line 2",
    "- 1": "holds no settings",
    "": "holds no settings",
    "dt_ns: !!int x": "not YAML .*invalid",
    "a: 1\nb: H\u00f6he": "line 2 is not UTF-8; save it as UTF-8",
    "a: !!python/object/apply:os.system ['true']": "not YAML .*constructor",
    "dt_nz: 3": "dt_nz: no such setting; (did you mean dt_ns|there are )|: missing",
}
NUMBERS = {
    "4.4e3": 4400.0, "9e-1": 0.9, "1e-05": 1e-5, "-.5E+3": -500.0, "1.": 1.0, "010": 10,
    "0o10": 8, "0x1F": 31, "1_000": 1000, "true": True, "yes": "yes", "1:30": "1:30",
    "2020-01-01": "2020-01-01", "~": None, "'1e3'": "1e3", "1e": "1e",
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("text", TEXTS)
def test_unreadable_files(tmp_path: Path, kind: type[Config], text: str) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(text, "latin-1")
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


def test_scalars_are_those_of_yaml_1_2_and_come_back_as_written(tmp_path: Path) -> None:
    (tmp_path / "one.yaml").write_text("".join(f"k{i}: {n}\n" for i, n in enumerate(NUMBERS)))
    values = read_values(tmp_path / "one.yaml")
    assert [*values.values()] == [*NUMBERS.values()]
    assert key_values(["a=4.4e3", "b=[1e3, 2]"]) == {"a": 4400.0, "b": [1000.0, 2]}
    (tmp_path / "two.yaml").write_text(yaml_text(values), encoding="utf-8")
    assert read_values(tmp_path / "two.yaml") == values
    # a byte order mark is no part of a file
    (tmp_path / "one.yaml").write_text("a: 1  # H\u00f6he\n", "utf-8-sig")
    assert read_values(tmp_path / "one.yaml") == {"a": 1}


def test_values_of_numpy_are_plain() -> None:
    value = {1: np.arange(2), "b": (np.float32(0.5), np.nan, np.array([[np.inf]]), None, "c")}
    assert plain(value) == {"1": [0, 1], "b": [0.5, None, [[None]], None, "c"]}


def test_a_recipe_that_matches_a_response_trains_no_networks():
    with pytest.raises(CpunetError, match=r"^recipe fast: does not train a CycleGAN$"):
        _ = load_recipe("fast").cyclegan


def test_all_recipes_see_the_same_pulses():
    fast, *others = (load_recipe(name) for name in list_recipes())
    for other in others:
        aligned = {"align_at": other.preparation.align_at}  # the paper's as published
        wanted = fast.preparation.model_copy(update=aligned)
        assert (other.peaks, other.preparation) == (fast.peaks, wanted)
        assert (other.cuts, other.scores) == (fast.cuts, fast.scores)


@pytest.mark.parametrize(
    ("room", "said"),
    [
        ("generator", "goes with training method cyclegan"),
        ("training", "goes with training method cyclegan"),
        ("discriminator", "a discriminator is needed for punet, and for it alone"),
    ],
)
def test_parts_of_different_trainings_are_not_mixed(room, said):
    fast, paper = (load_recipe(name).model_dump(mode="json") for name in ("fast", "paper"))
    for settings, part in ((fast, paper), (paper, fast)):
        with pytest.raises(CpunetError, match=f"mine: .*{said}"):
            checked(Recipe, settings | {room: part[room]}, "mine")


def test_values_are_overridden_in_turn():
    given = ["training.batch_size=16", "generator.width=8", "training.batch_size=8"]
    recipe = load_recipe("published", given)
    assert (recipe.training.batch_size, recipe.generator.width) == (8, 8)


WRONG = {
    "published": [
        ("training.batch_siez=16", "batch_siez: no such setting; did you mean batch_size?"),
        ("training.batch_size", "expected KEY=VALUE"),
        ("training.batch_size=[", "not YAML"),
        ("training.rate_generators=.nan", "training.rate_generators: "),
        ("discriminator.value_range=[1, 0]", "discriminator.value_range: must go from a lower"),
        ("preparation.before_ns=4800", "the loss windows cover 12800 ns"),
        ("preparation.baseline_ns=6400", "baseline_ns must be less than before_ns"),
    ],
    "paper": [("discriminator.view=window", "view must be spread behind a linear part")],
    "fast": [
        ("training.method=cyclegan", "training"),
        ("training.start_factors=[a, 1]", "training.start_factors.0: "),
        ("generator.slow_ns=[100, 100.0]", "times must differ"),
        ("training.level_ns=9000", "level_ns must be less than after_ns"),
        ("preparation.align_at=0.999", "align_at must be half_height"),
        ("generator.poles_ns=[40, -1]", "generator.poles_ns.1: "),
    ],
}


@pytest.mark.parametrize(
    ("recipe", "override", "part"),
    [(name, *row) for name, rows in WRONG.items() for row in rows],
)
def test_wrong_settings_are_named(recipe, override, part):
    one_line(lambda: load_recipe(recipe, [override]), part)


@pytest.mark.parametrize("dt_ns", [1, 2, 4, 7, 10, 12.5, 13, 16])
def test_windows_of_networks_are_halved_four_times_at_any_period(dt_ns):
    recipe = load_recipe("published").at(dt_ns)
    window = recipe.preparation
    assert window.length % 16 == 0
    assert window.length * dt_ns == pytest.approx(12_800, abs=16 * dt_ns)
    Recipe.model_validate(recipe.model_dump())  # as a run stores it


def test_values_of_a_file_and_of_words(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text("dt_ns: 4\nbias_V: 3000\n")
    expected = read_detector("ppc", ["bias_V=3000"]), SimulationSettings(dt_ns=2)
    assert detector_and_settings("ppc", [str(path), "dt_ns=2"]) == expected
    with pytest.raises(CpunetError, match="expected KEY=VALUE"):
        detector_and_settings("ppc", [str(tmp_path / "none.yaml")])
