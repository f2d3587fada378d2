"""Data of the interactive charts: nothing is lost, nothing is invented, little is stored."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import pytest

from cpunet.analysis.chart_data import (
    POINTS,
    distributions,
    method_looks,
    pulse_views,
    scatter_views,
    superpulse_views,
)
from cpunet.analysis.comparisons import compare
from cpunet.analysis.view_parts import packed, plain_label
from cpunet.errors import CpunetError
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS
from cpunet.recipes import load_recipe

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 5})


def unpacked(found: dict[str, Any]) -> np.ndarray:
    """Read what `packed` wrote, as the page does."""
    integers = np.frombuffer(base64.b64decode(found["data"]), f"<i{found['bits'] // 8}")
    values = found["offset"] + found["scale"] * integers.astype(float)
    values[integers == -(2 ** (found["bits"] - 1))] = np.nan
    return values.reshape(found["shape"])


def pulse(shift: float, rise: float = 6.0) -> np.ndarray:
    time = np.arange(400.0)
    return (1 / (1 + np.exp((200 + shift - time) / rise))).astype(np.float32)


@pytest.mark.parametrize("bits", [16, 32])
def test_packed_arrays_keep_their_values_and_their_gaps(bits):
    values = np.array([[-3.0, np.nan, 1e-3], [np.inf, 0.0, 7.0]])
    found = unpacked(packed(values, bits))
    expected = np.where(np.isfinite(values), values, np.nan)
    np.testing.assert_allclose(found, expected, atol=10 / 2**bits)


@pytest.mark.parametrize("values", [[], [np.nan, np.nan], [2.5, 2.5], [0.0]])
def test_packed_arrays_may_be_empty_or_constant(values):
    np.testing.assert_array_equal(unpacked(packed(values)), values)


def test_labels_lose_their_tex():
    labels = [plain_label(found.label) for found in SHAPE_PARAMETERS.values()]
    assert not any(character in label for label in labels for character in "$\\{}_")
    assert plain_label(r"$t_{10\,\%}$") == "t₁₀\N{NARROW NO-BREAK SPACE}%"


def test_each_method_has_one_colour_and_that_of_its_noise_free_kin():
    methods = ["data", "raw", "rc", "rc_no_noise", "gauss_exp", "ren", "rc"]
    looks = {found["name"]: found for found in method_looks(methods)}
    assert list(looks) == ["data", "raw", "rc", "rc_no_noise", "gauss_exp", "ren"]
    assert looks["rc"]["colour"] == looks["rc_no_noise"]["colour"]
    assert looks["rc_no_noise"]["dashed"]
    assert len({found["colour"] for found in looks.values()}) == 5


def test_distributions_count_every_pulse_in_the_bins_of_the_scores():
    rng = np.random.default_rng(1)
    data = {"drift_time": np.append(rng.normal(500, 20, 300), [np.nan, 1e6])}
    raw = {"drift_time": rng.normal(900, 20, 200)}
    comparison = compare(data, {"raw": raw}, SCORES, seed=0)
    found = distributions({"SEP": {"data": data, "raw": raw}}, {"SEP": comparison})["SEP"]
    shown = found["drift_time"]
    assert (shown["label"], shown["unit"]) == ("Drift time, 1 % to maximum", "ns")
    assert {method: sum(counts) for method, counts in shown["counts"].items()} == {
        "data": 302,
        "raw": 200,
    }
    assert shown["counts"]["data"][-1] == 1
    assert shown["counts"]["data"][-2] >= 1
    edges = np.linspace(shown["low"], shown["high"], len(shown["counts"]["data"]) - 2)
    expected, _ = np.histogram(data["drift_time"][:300], edges)
    np.testing.assert_array_equal(shown["counts"]["data"][1:-2], expected)
    # the overlap that is written beside the histograms is theirs
    shares = [np.array(c) / sum(c) for c in shown["counts"].values()]
    iou = 100 * np.minimum(*shares).sum() / np.maximum(*shares).sum()
    assert shown["iou"]["raw"][0] == pytest.approx(iou)


def test_what_cannot_be_shown_is_said():
    none = {"drift_time": np.full(3, np.nan)}
    found = distributions({"DEP": {}, "SEP": {"data": none}}, {})
    assert found["DEP"] == {"missing": "no measured pulses were scored"}
    assert found["SEP"]["drift_time"]["missing"] == "no measured pulse has a value"
    assert scatter_views({"DEP": {}})["peaks"]["DEP"]["missing"]
    assert superpulse_views({"DEP": {}}, {}, 16.0)["peaks"]["DEP"]["missing"]
    lost = {"raw": np.full((3, 400), np.nan, np.float32)}
    assert pulse_views({"DEP": lost, "SEP": {}}, 16.0)["peaks"]["DEP"]["missing"]


def test_superpulses_are_finer_than_their_errors():
    mean = np.stack([pulse(0), pulse(9)])
    one = {"n": np.array([10, 20]), "mean": mean, "error": np.full(mean.shape, 1e-5)}
    found = superpulse_views({"SEP": {"data": one}}, {"SEP": ["a", "b"]}, 16.0, 200)
    data = found["peaks"]["SEP"]["methods"]["data"]
    assert data["n"] == [10, 20]
    np.testing.assert_allclose(unpacked(data["mean"]), mean, atol=1e-8)
    json.dumps(found, allow_nan=False)


def test_the_nearest_measured_pulse_is_found():
    rises = (4.0, 8.0, 12.0)
    truth = np.stack([pulse(3, rise) for rise in rises])
    measured = np.stack([pulse(k % 7, 3 + 0.5 * k) for k in range(30)])
    clean = {"raw": np.stack([pulse(0, 2.0)] * 3), "truth": truth}
    found = pulse_views({"SEP": clean}, 16.0, {"SEP": measured}, events=3)["peaks"]["SEP"]
    assert found["rows"] == [0, 1, 2]
    assert (found["nearest_to"], found["searched"]) == ("truth", 30)
    shapes = {m: unpacked(p) for m, p in found["methods"].items()}
    # all cross half of their maximum at the same sample
    assert shapes["raw"][:, 160] == pytest.approx(shapes["truth"][:, 160], abs=0.01)
    difference = unpacked(found["nearest"]) - shapes["truth"]
    assert np.isfinite(difference[:, 20:350]).all()  # the ends of a record may differ
    assert np.nanmax(np.abs(difference)) < 1e-3


def test_events_that_a_method_loses_are_not_offered():
    ren = np.stack([pulse(k) for k in range(5)])
    ren[2] = np.nan
    clean = {"raw": np.stack([pulse(0)] * 5), "ren_no_noise": ren}
    found = pulse_views({"SEP": clean}, 16.0)["peaks"]["SEP"]
    assert found["rows"] == [0, 1, 3, 4]
    assert (found["usable"], found["n"]) == (4, 5)
    assert list(found["methods"]) == ["raw", "ren"]
    with pytest.raises(CpunetError, match="not the same events"):
        pulse_views({"SEP": {"raw": clean["raw"], "ren": ren[:3]}}, 16.0)


def test_scatter_keeps_few_points_and_says_how_many_there_are():
    rng = np.random.default_rng(3)
    time, height = rng.normal(500, 20, 4000), rng.normal(0.06, 0.01, 4000)
    time[:5] = np.nan
    values = {"SEP": {"data": {"drift_time": time, "current_amplitude": height}}}
    found = scatter_views(values)["peaks"]["SEP"]
    data = found["methods"]["data"]
    assert (data["n"], data["missing"]) == (3995, 5)
    x, y = unpacked(data["x"]), unpacked(data["y"])
    assert len(x) == len(y) == POINTS
    nearest = np.nanargmin(np.abs(time[:, None] - x[:20]), axis=0)
    np.testing.assert_allclose(height[nearest], y[:20], atol=1e-3)
    assert found["home"][0][0] < 480 < 520 < found["home"][0][1]
    assert scatter_views(values) == scatter_views(values)
