"""p-values and words: what statistics explain agrees, and what has no value says why."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest, norm

from cpunet.pulses.two_sample import TwoSample
from cpunet.validation.comparisons import Missing, compare, two_sample_test
from cpunet.validation.metrics import ALARM, Metrics, Verdict
from cpunet.validation.noise import Spectrum
from synthetic import load_recipe

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 60})


def one(p: float) -> dict[str, Any]:
    """A parameter whose mean differs by 5 ± 2."""
    of_ren = {"shift": {"ren": 5.0}, "shift_std": {"ren": 2.0}, "p": {"ren": p}}
    return {"iou": {"ren": 80.0, "ceiling": 85.9}, "mean": 500.0} | of_ren


def metrics() -> Metrics:
    auc = TwoSample(0.51, 0.02, 0.5, 0.02, 500, 500, 0, 0)
    survival = {"difference": {"ren": -9.5}, "difference_std": {"ren": 5.0}}
    p = {"current_amplitude": 0.5, "drift_time": 1e-4, "tail_slope": 0.9}
    parameters = {name: one(of_one) for name, of_one in p.items()}
    peaks = {
        "SEP": {"parameters": parameters, "two_sample": {"ren": auc}},
        "DEP": {"parameters": {}, "missing": "3 measured pulses"},
    }
    rows = {"DEP": {"cut": {"ren": 0.07}}, "SEP": survival}
    return Metrics(peaks=peaks, ae_survival=rows)


@pytest.mark.parametrize("sigma", [0.5, 2.9, 3.1, 20.0, 60.0])
def test_what_is_beyond_three_sigma_is_off(sigma):
    found = Verdict(float(2 * norm.sf(sigma)))
    if sigma < 37:
        assert found.sigma == pytest.approx(sigma)
    assert found.agrees is (sigma < 3)
    assert found.words.startswith("agrees" if sigma < 3 else "off by ")


def test_too_good_to_be_chance_asks_for_the_same_events():
    words = Verdict(1 - 1e-6).words
    assert words == "closer than statistics permit: are the same events on both sides?"
    values = np.random.default_rng(1).normal(size=400)
    assert Verdict(two_sample_test(values, values)[2]).words == words


def test_the_table_holds_every_quantity_and_is_json():
    content = metrics().to_dict()
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    table = content["verdicts"]["table"]
    assert table["DEP"] == {}
    sep = table["SEP"]["ren"]
    assert list(table["SEP"]) == ["ren"]  # and not the data
    assert [*sep] == ["current_amplitude", "drift_time", "tail_slope", "auc", "ae_survival"]
    assert sep["drift_time"]["words"] == "off by 3.9 sigma"
    assert sep["current_amplitude"]["numbers"] == "+1.00 ± 0.40 %"
    assert sep["auc"]["p"] == pytest.approx(0.31, abs=0.01)
    assert sep["ae_survival"]["p"] == pytest.approx(0.057, abs=0.001)


def test_an_agreement_is_quoted_with_its_sensitivity():
    assert metrics().summary("SEP") == (
        "REN, SEP: drift time off by 3.9 sigma (+5.0 ± 2.0 ns, p = 0.0001); agreement in "
        "current amplitude (+1.00 ± 0.40 %, p = 0.5), tail slope (+5.0 ± 2.0 1/ms, p = 0.9), "
        "classifier (AUC 0.510 ± 0.020, 0.50 expected, p = 0.31), A/E survival (−9.5 ± 5.0 "
        "points, p = 0.057)"
    )


def noise_of(ratio: float, worst: float = 0.3) -> dict[str, Spectrum]:
    """Noise of 1.95 ± 0.03 on the data's side, and that times a ratio on the other."""
    ren = Spectrum(rms=1.95 * ratio, rms_std=0.04, spectrum_sigma=worst)
    return {"data": Spectrum(rms=1.95, rms_std=0.03), "ren": ren}


def test_noise_that_differs_is_said():
    changed = metrics()
    sep = changed.peaks["SEP"]
    for ratio in (1.11, 0.89):  # too little of it is as wrong
        sep.noise = noise_of(ratio)
        line = changed.summary("SEP")
        assert f"noise off by 4.3 sigma (RMS {ratio:.3f} ± 0.026 of the data's" in line
    sep.noise = noise_of(1.01)
    assert "off" not in changed.summary("SEP").partition("noise")[2]
    sep.noise = noise_of(1.01, worst=5.5)
    assert "noise spectrum off by 5.6 sigma (worst band" in changed.summary("SEP")
    missing = Spectrum(missing="7 baselines; 10 are needed")
    sep.noise = dict.fromkeys(("data", "ren"), missing)
    assert "noise not judged (7 baselines; 10 are needed)" in changed.summary("SEP")


def test_the_summary_quotes_the_worst_first_and_says_why_others_are_not_scored():
    changed = metrics()
    sep = changed.peaks["SEP"]
    sep.two_sample["ren"] = replace(sep.two_sample["ren"], auc=0.7)
    line = changed.summary("SEP")
    assert line.index("classifier off") < line.index("drift time off") < line.index("agreement")
    sep.two_sample["ren"] = Missing(missing="12 measured pulses are usable")
    sep.parameters["drift_time"].p = {"ren": None}
    changed.survival["SEP"].difference = {"ren": None}
    line = changed.summary("SEP")
    assert "drift time not judged (too few pulses)" in line
    assert "classifier not judged (12 measured pulses are usable)" in line
    assert "A/E survival not judged (too few events" in line


def test_p_is_uniform_for_one_distribution_and_small_for_two():
    rng = np.random.default_rng(11)
    names = [f"p{i}" for i in range(200)]
    data, ren = ({name: rng.normal(size=n) for name in names} for n in (400, 300))
    for values in (data["p0"], ren["p0"]):
        values[:40] = np.nan  # a bin of its own
    shifted = {name: values + 0.8 for name, values in ren.items()}
    few = {"bootstraps": 2}
    found = compare(data, {"ren": ren, "shifted": shifted}, SCORES.model_copy(update=few), 1)
    p = np.array([found[name].p["ren"] for name in names])
    assert kstest(p, "uniform").pvalue > 0.01
    assert (p < ALARM).mean() <= 0.01
    assert max(found[name].p["shifted"] for name in names) < 0.01


def test_errors_of_a_fit_are_in_p_and_in_the_error_of_the_mean():
    """Both sides differ by what a fit may be off: its axis moves all values by that much."""
    rng, error = np.random.default_rng(5), 0.1
    p, pulls = [], []
    for _ in range(200):
        data, ren = rng.normal(size=400), rng.normal(size=400) + error * rng.normal()
        moved = np.array([[ren + error, ren - error]])
        found = compare({"a": data}, {"ren": {"a": ren}}, SCORES, 1, {"ren": {"a": moved}})["a"]
        p.append(found.p["ren"])
        pulls.append(found.shift["ren"] / found.shift_std["ren"])
    assert kstest(p, "uniform").pvalue > 0.01
    assert np.std(pulls) == pytest.approx(1, abs=0.15)
