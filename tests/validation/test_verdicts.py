"""Scores in plain words: what chance explains agrees, and what has no value says why."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np
import pytest

from cpunet.validation.comparisons import compare
from cpunet.validation.verdicts import summary, verdict, verdict_table
from synthetic import load_recipe

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 60})


def one(iou: float, w1: float = 5.0) -> dict[str, Any]:
    """A parameter with a ceiling of 85.9 ± 0.9 and a null of 5 ± 2."""
    return {
        "iou": {"ren": iou, "ceiling": 85.9},
        "iou_std": {"ren": 3.0, "ceiling": 0.9},
        "wasserstein": {"ren": w1},
        "wasserstein_null": 5.0,
        "wasserstein_null_std": 2.0,
    }


def metrics() -> dict[str, Any]:
    auc = {"auc": 0.51, "auc_std": 0.02, "null_mean": 0.5, "null_std": 0.02}
    survival = {"difference": {"ren": 1.0}, "difference_std": {"ren": 2.0}}
    return {
        "peaks": {
            "SEP": {
                "parameters": {
                    "current_amplitude": one(86.5),
                    "drift_time": one(83.1),
                    "tail_slope": one(85.0),
                },
                "two_sample": {"ren": auc},
            },
            "DEP": {"parameters": {}, "missing": "3 measured pulses"},
        },
        "ae_survival": {"DEP": {"cut": {"ren": 0.07}}, "SEP": survival},
    }


@pytest.mark.parametrize(
    ("value", "worse", "sigma", "agrees"),
    [
        (83.0, "lower", 3.0, False),
        (84.1, "lower", 1.9, True),
        (88.1, "lower", -2.1, True),
        (88.3, "higher", 2.3, False),
        (83.0, "higher", -3.0, True),
        (83.1, "both", -2.9, False),
        (89.0, "both", 3.0, False),
        (87.1, "both", 1.1, True),
    ],
)
def test_only_the_worse_side_is_off(value, worse, sigma, agrees):
    found = verdict(value, 86.0, 1.0, worse)
    assert found.sigma == pytest.approx(sigma)
    assert found.agrees is agrees
    words = f"off by {abs(found.sigma):.1f} sigma"
    assert found.words == ("agrees within errors" if agrees else words)


def test_too_good_to_be_chance_asks_for_the_same_events():
    found = verdict(99.0, 86.0, 2.0, "lower")
    assert found.agrees
    assert found.words == "closer than chance by 6.5 sigma: are the same events on both sides?"


def test_the_table_holds_every_quantity_and_is_json():
    table = verdict_table(metrics())
    assert json.loads(json.dumps(table, allow_nan=False)) == table
    assert table["DEP"] == {}
    sep = table["SEP"]["ren"]
    assert list(table["SEP"]) == ["ren"]  # and no ceiling
    assert list(sep) == [
        "current_amplitude",
        "current_amplitude_wasserstein",
        "drift_time",
        "drift_time_wasserstein",
        "tail_slope",
        "tail_slope_wasserstein",
        "auc",
        "ae_survival",
    ]
    assert sep["drift_time"]["sigma"] == pytest.approx(2.8 / 0.9)
    assert sep["drift_time"]["words"] == "off by 3.1 sigma"
    assert sep["auc"]["sigma"] == pytest.approx(0.5)
    assert sep["ae_survival"] == {"sigma": 0.5, "words": "agrees within errors"}


def test_the_summary_says_what_agrees_and_what_is_off():
    assert summary(metrics(), "SEP", "ren") == (
        "REN, SEP: current amplitude, tail slope, classifier and A/E survival agree with the "
        "data within errors; drift time off by 3.1 sigma (IoU 83.1 of 85.9)"
    )


def noise_of(ratio: float, worst: float = 0.3) -> dict[str, Any]:
    """Noise of 1.95 ± 0.03 on the data's side, and that times a ratio on the other."""
    ren = {"rms": 1.95 * ratio, "rms_std": 0.04, "rms_ratio": ratio, "spectrum_sigma": worst}
    return {"frequency_mhz": [1.0], "data": {"rms": 1.95, "rms_std": 0.03}, "ren": ren}


def test_noise_that_differs_is_said():
    changed = metrics()
    sep = changed["peaks"]["SEP"]
    sep["noise"] = noise_of(1.01)
    assert "A/E survival and noise agree with the data" in summary(changed, "SEP", "ren")
    sep["noise"] = noise_of(1.11)
    assert "; noise off by 4.3 sigma (RMS 1.11 of the data's)" in summary(changed, "SEP", "ren")
    found = verdict_table(changed)["SEP"]["ren"]
    assert found["noise"]["sigma"] == pytest.approx(1.95 * 0.11 / 0.05)
    assert found["noise_spectrum"] == {"sigma": 0.3, "words": "agrees within errors"}
    sep["noise"] = noise_of(0.89)  # too little of it is as wrong
    assert "noise off by 4.3 sigma (RMS 0.89" in summary(changed, "SEP", "ren")
    sep["noise"] = noise_of(1.01, worst=5.5)
    words = "noise off by 5.5 sigma (worst band of its spectrum; RMS 1.01 of the data's)"
    assert words in summary(changed, "SEP", "ren")
    sep["noise"] = {m: {"missing": "7 baselines; 10 are needed"} for m in ("data", "ren")}
    assert "noise not judged (7 baselines; 10 are needed)" in summary(changed, "SEP", "ren")


def test_the_summary_quotes_the_worst_first():
    changed = metrics()
    sep = changed["peaks"]["SEP"]
    sep["parameters"] = {"drift_time": one(83.1, w1=15.0)}
    sep["two_sample"]["ren"]["auc"] = 0.6
    changed["ae_survival"]["SEP"]["difference"]["ren"] = -8.0
    assert summary(changed, "SEP", "ren") == (
        "REN, SEP: drift time off by 5.0 sigma (W₁ 15 ns, by chance 5 ns); "
        "classifier off by 5.0 sigma (AUC 0.60, by chance 0.50); "
        "A/E survival off by 4.0 sigma (-8.0 points)"
    )


def test_what_is_not_scored_says_why():
    changed = metrics()
    sep = changed["peaks"]["SEP"]
    sep["two_sample"]["ren"] = {"missing": "12 measured pulses are usable"}
    sep["parameters"]["drift_time"]["iou"]["ren"] = None
    sep["parameters"]["drift_time"]["wasserstein"]["ren"] = None
    changed["ae_survival"]["SEP"]["difference"]["ren"] = None
    line = summary(changed, "SEP", "ren")
    assert "drift time not judged (no value)" in line
    assert "classifier not judged (12 measured pulses are usable)" in line
    assert "A/E survival not judged (too few events" in line


def test_what_compare_gives_is_judged_rightly():
    """Samples of one distribution agree, and a shifted one does not, for many parameters."""
    rng = np.random.default_rng(11)
    names = [f"p{i}" for i in range(40)]
    data, ren = ({name: rng.normal(size=400) for name in names} for _ in range(2))
    shifted = {name: values + 0.4 for name, values in copy.deepcopy(ren).items()}
    found = compare(data, {"ren": ren, "shifted": shifted}, SCORES, seed=1)
    table = verdict_table({"peaks": {"SEP": {"parameters": found}}})["SEP"]
    assert len(table["ren"]) == 80
    # 4 … 7 % are expected
    assert sum(words["sigma"] > 2 for words in table["ren"].values()) <= 12
    w1 = [words["sigma"] for n, words in table["shifted"].items() if n.endswith("wasserstein")]
    assert min(w1) > 2
