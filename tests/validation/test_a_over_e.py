"""A/E: the cut, and its course with energy, against analytic values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from cpunet.validation.a_over_e import (
    SurvivalRow,
    ae_survival,
    peak_survival,
    sideband_survival,
    survival_table,
)
from cpunet.validation.ae_energy import against_energy, site_fit
from cpunet.validation.run_figures import ae_energy_figure, roc_figure

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


@pytest.mark.parametrize("n_dep", [20, 24, 61])
def test_new_events_survive_with_the_acceptance_however_few_set_the_cut(n_dep):
    rng = np.random.default_rng(1)
    cuts = [ae_survival(rng.random(n_dep), {}, bootstraps=2)[0] for _ in range(1500)]
    assert 1 - np.mean(cuts) == pytest.approx(0.9, abs=0.006)


@pytest.mark.parametrize(("n_dep", "n_sep"), [(100, 2000), (2000, 60), (400, 400)])
def test_errors_cover_the_truth(n_dep, n_sep):
    """The error of the cut dominates in the first case, the counts in the second."""
    rng = np.random.default_rng(2)
    found = []
    for _ in range(250):
        sample = peaks(rng, n_dep, n_sep)
        cut, cut_std, survived = ae_survival(sample.pop("DEP"), sample, bootstraps=40, seed=rng)
        found.append((*survived["SEP"], cut, cut_std))
    survivals, stds, cuts, cut_stds = np.array(found).T
    assert np.std(survivals) == pytest.approx(np.mean(stds), rel=0.15)
    assert np.std(cuts) == pytest.approx(np.mean(cut_stds), rel=0.15)
    within = np.abs(survivals - SEP_SURVIVAL) < 2 * stds
    assert 0.91 < within.mean() < 0.99


def test_table_of_a_method_that_agrees_and_one_that_does_not():
    rng = np.random.default_rng(4)
    # the scale of A/E is another: each set has its own cut, and it must not matter
    good = peaks(rng, 3000, 3000, scale=0.9)
    bad = peaks(rng, 3000, 3000) | {"SEP": rng.normal(10, 1, 3000)}
    table = survival_table(by_peak(data=peaks(rng, 3000, 3000), good=good, bad=bad))
    sep = table["SEP"]
    assert sep.survival["data"] == pytest.approx(SEP_SURVIVAL, abs=4)
    assert abs(sep.sigma["good"]) < 3
    assert sep.difference["bad"] == pytest.approx(90 - SEP_SURVIVAL, abs=5)
    assert sep.sigma["bad"] > 10
    for method in ("good", "bad"):
        # as many events give the errors of both in quadrature
        std = np.hypot(sep.survival_std[method], sep.survival_std["data"])
        assert sep.difference_std[method] == pytest.approx(std, rel=0.3)
    assert not table["DEP"].survival
    assert not sep.cut
    assert table["DEP"].cut["good"] == pytest.approx(0.9 * (10 + ndtri(0.1)), abs=0.1)


def test_table_says_what_does_not_exist():
    rng = np.random.default_rng(6)
    data = peaks(rng) | {"FEP": np.array([])}
    data["DEP"] = np.r_[data["DEP"], np.inf, np.nan]
    few = peaks(rng, n_dep=5) | {"FEP": np.array([9.0, np.nan])}
    table = survival_table(by_peak(data=data, few=few))
    assert table["DEP"].events == {"data": 800, "few": 5}
    assert table["DEP"].missing == {"data": 2, "few": 0}
    assert table["DEP"].cut["few"] is None
    assert table["SEP"].survival["few"] is None
    assert table["SEP"].sigma["few"] is None
    assert table["SEP"].survival["data"] > 0
    assert table["FEP"].events == {"data": 0, "few": 1}
    assert table["FEP"].missing == {"data": 0, "few": 1}
    assert set(table["FEP"].survival.values()) == {None}
    assert "lack peak DEP" in survival_table({"SEP": {"data": data["SEP"]}}).missing


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
    assert found.survival == pytest.approx(50, abs=1)
    assert found.scale == pytest.approx(10 / 60)
    assert found.undefined == 10
    in_peak = (energy >= 2098.5) & (energy < 2108.5) & np.isfinite(amplitude)
    assert found.peak == in_peak.sum()
    assert found.peak_pass == (amplitude[in_peak] >= 0.7).sum()
    # no error is zero where all or none survive, with sidebands without events or none
    for cut, sidebands in ((0.0, []), (2.0, []), (0.0, [(1990, 2000)]), (2.0, [(1990, 2000)])):
        few = peak_survival(np.ones(8), np.full(8, 2039.0), cut, (2004, 2074), sidebands)
        assert 5 < few.survival_std < 15


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
    assert reason in found.missing
    assert found.survival is None


def test_curves_of_survival_are_the_analytic_ones():
    """Of uniform amplitudes a cut that leaves a part p of one leaves 2 p - 1 of the other."""
    single, other = np.linspace(1, 3, 2001), np.linspace(0, 2, 2001)
    unknown = np.append(other, np.nan)
    drawn = roc_figure(
        {"SEP": {"data": unknown, "ren": other}, "DEP": dict.fromkeys(("data", "ren"), single)}
    )
    (axes,) = drawn.axes
    assert [line.get_label() for line in axes.lines] == ["Data", "REN translation"]
    for line in axes.lines:
        accepted, left = line.get_data()
        assert left == pytest.approx(np.clip(2 * accepted - 100, 0, 100) / 2, abs=0.2)


LINES = {"DEP": (1587.5, 1597.5), "SEP": (2098.5, 2108.5), "FEP": (2609.5, 2619.5)}
SCALE, SLOPE = 0.08, -1.5e-6  # per keV
WIDTH, NOISE_KEV = 0.004, 6.0


def events(
    energy: np.ndarray, several: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A/E of events of which a share has several sites, and so a lower one."""
    mean = SCALE * (1 + SLOPE * (energy - 1592.5))
    sigma = mean * np.hypot(WIDTH, NOISE_KEV / energy)
    lower = np.where(rng.random(len(energy)) < several, rng.exponential(0.02, len(energy)), 0)
    return rng.normal(mean - lower, sigma), energy


def joined(*sets: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return tuple(np.concatenate(parts) for parts in zip(*sets, strict=True))


def line(low: float, n: int, several: float, rng: np.random.Generator):
    return events(rng.uniform(low, low + 10, n), several, rng)


@pytest.mark.thorough
def test_the_line_through_the_continuum() -> None:
    pulls, widths = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        amplitude, energy = joined(
            events(rng.uniform(950, 1750, 3000), 0.5, rng), line(1587.5, 500, 0.1, rng)
        )
        found = against_energy({"data": amplitude}, {"data": energy}, LINES)
        assert not found.multi_site
        mean, law = found.methods["data"].mean, found.methods["data"].resolution
        pulls.append((mean.a - SLOPE) / mean.a_error)
        assert mean.a * 1592.5 + mean.b == pytest.approx(1)
        assert mean.per_mev_percent == pytest.approx(1e5 * mean.a)
        assert mean.chi_square < 2.5 * mean.degrees
        widths.append(law.of(np.array([1000, 1700])))
    assert abs(np.mean(pulls)) < 0.7
    assert 0.6 < np.std(pulls) < 1.5
    expected = np.hypot(WIDTH, NOISE_KEV / np.array([1000, 1700]))
    np.testing.assert_allclose(np.mean(widths, axis=0), expected, rtol=0.08)


def test_a_wide_line_is_no_continuum() -> None:
    rng, wide = np.random.default_rng(1), (1560.0, 1625.0)
    ranges = ((*wide, 600, 0.1), (1000, 1500, 3000, 0.4))
    a, kev = joined(*(events(rng.uniform(*ends, n), some, rng) for *ends, n, some in ranges))
    found = against_energy({"data": a}, {"data": kev}, {"DEP": wide})
    assert wide in [(p.low_kev, p.high_kev) for p in found.methods["data"].points]


def test_lines_of_many_sites_are_fitted_about_the_single_ones() -> None:
    rng = np.random.default_rng(1)
    shares = {1587.5: 0.1, 2098.5: 0.85, 2609.5: 0.8}
    made = joined(*(line(low, 4000, several, rng) for low, several in shares.items()))
    amplitude, energy = (dict.fromkeys(("data", "ren"), one) for one in made)
    found = against_energy(amplitude, energy, LINES)
    assert found.multi_site
    mean = found.methods["ren"].mean
    assert mean.a == pytest.approx(SLOPE, abs=4 * mean.a_error)
    assert mean.per_mev_error_percent < 0.1
    assert found.methods["data"].scale == pytest.approx(SCALE, rel=1e-3)
    axes = ae_energy_figure(found.methods).axes
    assert len(axes) == 2
    assert "% per MeV" in axes[0].get_legend().get_texts()[0].get_text()


def test_too_few_events_are_told() -> None:
    rng = np.random.default_rng(2)
    few = line(1587.5, 30, 0.1, rng)
    found = against_energy({"data": few[0]}, {"data": few[1]}, LINES)
    assert "0 ranges" in found.missing
    nothing = np.full(500, np.nan)
    assert against_energy({"data": nothing}, {"data": 2000 + 0 * nothing}, LINES).missing
    assert site_fit(np.full(500, 0.1)) is None


def test_bootstraps_that_do_not_differ_are_no_error() -> None:
    row = SurvivalRow()
    row.compare({"data": (40.0, 3.0), "raw": (0.0, 4.0)}, {"raw": 0.0})
    assert row.difference_std == {"raw": 5.0}
    assert row.sigma == {"raw": -8.0}
