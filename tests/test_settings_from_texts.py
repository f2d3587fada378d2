"""Texts of settings that nobody means: one line each, whatever YAML makes of them."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from cpunet.electronics.presets import read_electronics
from cpunet.errors import CpunetError
from cpunet.jobs.simulation.simulation_settings import load_settings, split_overrides
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.shifted import Shift
from cpunet.yaml_files import parsed, plain_json, shown

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9)
)
TEXTS = {
    "int that is none": "dt_ns: !!int abc",
    "hexadecimal of nothing": "dt_ns: 0x",
    "5000 digits": f"dt_ns: {'1' * 5000}",
    "400 digits": f"dt_ns: {'1' * 400}",
    "deep": "a: " + "[" * 1000,
    "deep and closed": "a: " + "[" * 1000 + "]" * 1000,
    "deep mappings": "".join(f"{' ' * i}a:\n" for i in range(200)),
    "references": BOMB,
    "itself": "a: &a [*a]",
    "unknown tag": "dt_ns: !mine 3",
    "binary": "dt_ns: !!binary '*'",
    "list as key": "? [1, 2]\n: 3",
    "mapping as key": "? {a: 1}\n: 3",
    "infinite": "dt_ns: .inf",
    "none": "dt_ns: .nan",
    "date": "dt_ns: 2020-99-99",
    "true": "dt_ns: true",
    "nothing": "dt_ns:",
    "control": "dt_ns: \x07",
    "two documents": "dt_ns: 16\n---\ndt_ns: 16",
    "a number": "3",
    "a list": "- 1",
    "empty": "",
    "half": "{dt_ns: ",
    "surrogate": '"\\ud800": 3',
    "number as key": "3: 4",
    "large": "dt_ns: 1.0e+300",
}
READERS: dict[str, Callable[[Path], object]] = {
    "settings": load_settings,
    "detector": read_detector,
    "electronics": read_electronics,
    "recipe": lambda path: load_recipe(str(path)),
    "shift": lambda path: Shift.of([str(path)]),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("text", TEXTS)
def test_any_text_is_one_line(tmp_path, reader, text):
    path = tmp_path / "given.yaml"
    path.write_text(TEXTS[text], encoding="utf-8")
    begun = time.monotonic()
    with pytest.raises(CpunetError) as error:
        READERS[reader](path)
    assert time.monotonic() - begun < 5
    line = str(error.value)
    assert str(path) in line or reader == "shift"  # of which several may be given
    assert "\n" not in line
    assert len(line) < 1200


@pytest.mark.parametrize("reader", READERS)
def test_files_that_are_none(tmp_path, reader):
    large = tmp_path / "large.yaml"
    large.write_bytes(b"a" * 11_000_000)
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    for path in (large, binary, tmp_path):
        with pytest.raises(CpunetError, match=re.escape(str(path))):
            READERS[reader](path)
    name = tmp_path / ("x" * 300)
    with pytest.raises((CpunetError, OSError)):
        READERS[reader](name)


# the same values on the command line
VALUES = [text.partition(": ")[2] for text in TEXTS.values() if text.startswith("dt_ns: ")]


@pytest.mark.parametrize("value", VALUES)
def test_any_value_is_one_line(value):
    calls: list[Callable[[], object]] = [
        lambda: load_settings(values=split_overrides([f"dt_ns={value}"])[1]),
        lambda: read_detector("icpc", [f"bias_V={value}"]),
        lambda: load_recipe("fast", [f"preparation.samples_before={value}"]),
        lambda: Shift.of([f"bias_V={value}"]).detector(read_detector("icpc")),
    ]
    for call in calls:
        with pytest.raises(CpunetError) as error:
            call()
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 500


# settings beyond all reason, which were taken before
BEYOND = {
    "bias_V=1e9": "icpc",
    "crystal_length=1e9": "icpc",
    "vacuum_gap=.inf": "icpc",
    "vacuum_gap=1e9": "icpc",
    "impurity_z0_1e10_per_cm3=-1e30": "icpc",
    "surface_charge_1e10_per_cm2=.nan": "icpc",
    "length_ns=.inf": "settings",
    "length_ns=1e7": "settings",
    "dt_ns=.inf": "settings",
    "cloud_fwhm_mm=.inf": "settings",
    "step_ns=1e-9": "settings",
    "library_grid_mm=1e-9": "settings",
    "library_angles=2000000000": "settings",
    "training.components=100000": "fast",
    "training.search_pulses=10000000000000": "fast",
    "preparation.samples_after=1000000000": "fast",
    "scores.max_bins=10000000000": "fast",
    "discriminator.embedding_rows=2000000000": "paper",
    "generator.width=100000": "paper",
    "training.batch_size=1000000000": "paper",
    "training.rate_generators=.inf": "paper",
}


@pytest.mark.parametrize("setting", BEYOND)
def test_settings_beyond_all_reason(setting):
    kind, key = BEYOND[setting], setting.partition("=")[0]
    readers: dict[str, Callable[[], object]] = {
        "icpc": lambda: read_detector("icpc", [setting]),
        "settings": lambda: load_settings(values=split_overrides([setting])[1]),
    }
    read = readers.get(kind, lambda: load_recipe(kind, [setting]))
    with pytest.raises(CpunetError, match=key.rpartition(".")[2]) as error:
        read()
    assert "\n" not in str(error.value)


@given(st.text(max_size=60))
def test_texts_are_values_or_an_error(text):
    try:
        value = parsed(text)
    except yaml.YAMLError:
        return
    assert len(shown(value)) <= 80


@given(st.binary(max_size=60))
def test_json_is_a_value_or_an_error(content):
    try:
        plain_json(content)
    except ValueError:
        return


def test_dates_are_text_and_values_stay_what_they_were():
    assert parsed("at: 2020-01-01") == {"at": "2020-01-01"}
    assert parsed("[1, 2.5, true, null, a, 0x10]") == [1, 2.5, True, None, "a", 16]
    assert parsed("a: &x {b: 1}\nc: *x") == {"a": {"b": 1}, "c": {"b": 1}}
