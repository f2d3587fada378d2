"""The A/E cut against analytic survivals, and its errors against repeated draws."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from cpunet.validation.a_over_e import (
    ae_survival,
    peak_survival,
    sideband_survival,
    survival_by_range,
    survival_table,
)

SEP_MEAN = -1.0  # in widths of the DEP, whose cut at 90 % lies at -1.28
SEP_SURVIVAL = 100 * ndtr(SEP_MEAN - ndtri(0.1))


def peaks(rng, n_dep=800, n_sep=1000, scale=1.0):
    return {
        "DEP": scale * rng.normal(10, 1, n_dep),
        "SEP": scale * rng.normal(10 + SEP_MEAN, 1, n_sep),
    }


def by_peak(**sets):
    """A/E by peak and method, of sets by method and peak."""
    return {peak: {m: of_set[peak] for m, of_set in sets.items()} for peak in sets["data"]}


def test_survival_is_the_analytic_one():
    sample = peaks(np.random.default_rng(0), 200_000, 200_000)
    result = ae_survival(sample.pop("DEP"), sample, bootstraps=20)
    assert result.cut == pytest.approx(10 + ndtri(0.1), abs=0.02)
    assert result.peaks["SEP"].survival == pytest.approx(SEP_SURVIVAL, abs=0.8)


@pytest.mark.parametrize("n_dep", [20, 24, 61])
def test_new_events_survive_with_the_acceptance_however_few_set_the_cut(n_dep):
    rng = np.random.default_rng(1)
    cuts = [ae_survival(rng.random(n_dep), {}, bootstraps=2).cut for _ in range(1500)]
    assert 1 - np.mean(cuts) == pytest.approx(0.9, abs=0.006)


@pytest.mark.parametrize(("n_dep", "n_sep"), [(100, 2000), (2000, 60), (400, 400)])
def test_errors_cover_the_truth(n_dep, n_sep):
    """The error of the cut dominates in the first case, the counts in the second."""
    rng = np.random.default_rng(2)
    survivals, stds, cuts, cut_stds = [], [], [], []
    for _ in range(250):
        sample = peaks(rng, n_dep, n_sep)
        result = ae_survival(sample.pop("DEP"), sample, bootstraps=40, seed=rng)
        survivals.append(result.peaks["SEP"].survival)
        stds.append(result.peaks["SEP"].std)
        cuts.append(result.cut)
        cut_stds.append(result.cut_std)
    assert np.std(survivals) == pytest.approx(np.mean(stds), rel=0.15)
    assert np.std(cuts) == pytest.approx(np.mean(cut_stds), rel=0.15)
    within = np.abs(np.array(survivals) - SEP_SURVIVAL) < 2 * np.array(stds)
    assert 0.91 < within.mean() < 0.99


def test_table_of_a_method_that_agrees_and_one_that_does_not():
    rng = np.random.default_rng(4)
    # the scale of A/E is another: each set has its own cut, and it must not matter
    good = peaks(rng, 3000, 3000, scale=0.9)
    bad = peaks(rng, 3000, 3000) | {"SEP": rng.normal(10, 1, 3000)}
    table = survival_table(by_peak(data=peaks(rng, 3000, 3000), good=good, bad=bad))
    sep = table["SEP"]
    assert sep["survival"]["data"] == pytest.approx(SEP_SURVIVAL, abs=4)
    assert abs(sep["sigma"]["good"]) < 3
    assert sep["difference"]["bad"] == pytest.approx(90 - SEP_SURVIVAL, abs=5)
    assert sep["sigma"]["bad"] > 10
    for method in ("good", "bad"):
        difference = sep["survival"][method] - sep["survival"]["data"]
        std = np.hypot(sep["survival_std"][method], sep["survival_std"]["data"])
        assert sep["difference"][method] == pytest.approx(difference)
        assert sep["difference_std"][method] == pytest.approx(std)
        assert sep["sigma"][method] == pytest.approx(difference / std)
    assert table["DEP"].keys() == {"events", "missing", "cut", "cut_std"}
    assert table["DEP"]["cut"]["good"] == pytest.approx(0.9 * (10 + ndtri(0.1)), abs=0.1)


def test_sigma_of_agreeing_sets_is_standard_normal():
    rng = np.random.default_rng(5)
    sigmas = [
        survival_table(
            by_peak(data=peaks(rng, 300, 300), ren=peaks(rng, 500, 700)),
            bootstraps=40,
            seed=rng,
        )["SEP"]["sigma"]["ren"]
        for _ in range(200)
    ]
    assert np.mean(sigmas) == pytest.approx(0, abs=0.25)
    assert np.std(sigmas) == pytest.approx(1, abs=0.15)


def test_table_is_json_and_says_what_does_not_exist():
    rng = np.random.default_rng(6)
    data = peaks(rng) | {"FEP": np.array([])}
    data["DEP"] = np.r_[data["DEP"], np.inf, np.nan]
    few = peaks(rng, n_dep=5) | {"FEP": np.array([9.0, np.nan])}
    table = json.loads(json.dumps(survival_table(by_peak(data=data, few=few)), allow_nan=False))
    assert table["DEP"]["events"] == {"data": 800, "few": 5}
    assert table["DEP"]["missing"] == {"data": 2, "few": 0}
    assert table["DEP"]["cut"]["few"] is None
    assert table["SEP"]["survival"]["few"] is None
    assert table["SEP"]["sigma"] == {"few": None}
    assert table["SEP"]["survival"]["data"] > 0
    assert table["FEP"]["events"] == {"data": 0, "few": 1}
    assert table["FEP"]["missing"] == {"data": 0, "few": 1}
    assert table["FEP"]["survival"] == {"data": None, "few": None}
    assert "lack peak DEP" in survival_table({"SEP": {"data": data["SEP"]}})["missing"]


def test_without_a_background_the_error_is_binomial():
    survival, std = sideband_survival(30, 120, 0, 0, scale=1.0)
    assert survival == pytest.approx(25)
    assert std == pytest.approx(100 * np.sqrt(0.25 * 0.75 / 120))


def test_sideband_error_is_the_spread_over_repeated_experiments():
    rng = np.random.default_rng(9)
    results = []
    for _ in range(4000):
        signal, below, beside = rng.poisson([400, 150, 450])
        passing = rng.binomial(signal, 0.6) + rng.binomial(below, 0.2)
        side_pass = rng.binomial(beside, 0.2)
        results.append(sideband_survival(passing, signal + below, side_pass, beside, 1 / 3))
    survivals, stds = np.array(results).T
    assert survivals.mean() == pytest.approx(60, abs=0.3)
    assert survivals.std() == pytest.approx(stds.mean(), rel=0.05)


def test_survival_of_a_line_is_that_of_its_own_events():
    rng = np.random.default_rng(8)
    n_line, n_flat = 40_000, 60_000
    energy = np.r_[rng.normal(2103.5, 1, n_line), rng.uniform(2050, 2150, n_flat)]
    amplitude = np.r_[rng.random(n_line) + 0.2, rng.random(n_flat)]
    amplitude[:10] = np.nan
    found = peak_survival(
        amplitude, energy, 0.7, (2098.5, 2108.5), [(2060, 2090), (2117, 2147)]
    )
    assert found["survival"] == pytest.approx(50, abs=1)
    assert found["scale"] == pytest.approx(10 / 60)
    assert found["undefined"] == 10
    in_peak = (energy >= 2098.5) & (energy < 2108.5) & np.isfinite(amplitude)
    assert found["peak"] == in_peak.sum()
    assert found["peak_pass"] == (amplitude[in_peak] >= 0.7).sum()
    json.dumps(found, allow_nan=False)


def test_no_error_is_zero_where_all_or_none_survive():
    energies = np.full(8, 2039.0)
    for cut in (0.0, 2.0):
        for sidebands in ([], [(1990, 2000)]):  # without events
            found = peak_survival(np.ones(8), energies, cut, (2004, 2074), sidebands)
            assert 5 < found["survival_std"] < 15


@pytest.mark.parametrize(
    ("cut", "peak", "sidebands", "reason"),
    [
        (0.5, (100, 110), [], "no events from 100 to 110 keV"),
        (np.nan, (2000, 2010), [], "there is no cut"),
        (0.5, (2000, 2010), [(2010, 2012)], "the sidebands leave no events of 3"),
    ],
)
def test_without_events_there_is_a_reason(cut, peak, sidebands, reason):
    energies = np.array([2005.0, 2005, 2005, 2011])
    found = peak_survival(np.ones(4), energies, cut, peak, sidebands)
    assert reason in found["missing"]
    assert "survival" not in found


def test_every_range_and_method_with_its_own_cut():
    amplitude = {"data": np.array([0.4, 0.6]), "ren": np.array([0.4, 0.6])}
    energy = dict.fromkeys(amplitude, np.array([10.0, 10.0]))
    table = survival_by_range(
        amplitude,
        energy,
        {"data": 0.5, "ren": 0.3},
        {"line": ((9, 11), [(20, 30)])},
        {"continuum": (5, 15)},
    )
    assert list(table) == ["line", "continuum"]
    assert table["line"]["data"]["survival"] == 50
    assert table["continuum"]["ren"]["survival"] == 100
