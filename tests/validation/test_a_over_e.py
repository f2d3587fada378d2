"""A/E: the cut, and its course with energy, against analytic values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from cpunet.validation.a_over_e import dep_cuts, range_survival, survivals
from cpunet.validation.ae_energy import against_energy, site_fit
from cpunet.validation.figures import ae_energy_figure, roc_figure

SEP_MEAN = -1.0  # in widths of the DEP, whose cut at 90 % lies at -1.28
SEP_SURVIVAL = 100 * ndtr(SEP_MEAN - ndtri(0.1))
LINES = {"DEP": (1587.5, 1597.5), "SEP": (2098.5, 2108.5), "FEP": (2609.5, 2619.5)}
SCALE, SLOPE = 0.08, -1.5e-6  # per keV
WIDTH, NOISE_KEV = 0.004, 6.0


def peaks(rng, n_dep=800, n_sep=1000, scale=1.0):
    return {
        "DEP": scale * rng.normal(10, 1, n_dep),
        "SEP": scale * rng.normal(10 + SEP_MEAN, 1, n_sep),
    }


def survival_table(energies=None, bands=None, **sets):
    """Survival by peak, of A/E of sets by method and peak, and of bands if there are some."""
    by_peak = {peak: {m: of_set[peak] for m, of_set in sets.items()} for peak in sets["data"]}
    amplitudes = {m: np.concatenate([*of_set.values()]) for m, of_set in sets.items()}
    return survivals(by_peak, amplitudes, energies or {}, bands or {})[0]


@pytest.mark.parametrize("n_dep", [20, 24, 61])
def test_new_events_survive_with_the_acceptance_however_few_set_the_cut(n_dep):
    rng = np.random.default_rng(1)
    cuts = [dep_cuts(rng.random(n_dep), rng, bootstraps=1)[0] for _ in range(1500)]
    assert 1 - np.mean(cuts) == pytest.approx(0.9, abs=0.006)


@pytest.mark.parametrize(("n_dep", "n_sep"), [(100, 2000), (2000, 60), (400, 400)])
def test_errors_cover_the_truth(n_dep, n_sep):
    """The error of the cut dominates in the first case, the counts in the second."""
    rng = np.random.default_rng(2)
    results = []
    for _ in range(250):
        sample = peaks(rng, n_dep, n_sep)
        cuts = dep_cuts(sample["DEP"], rng, bootstraps=40)
        of = range_survival(sample["SEP"], cuts)
        results.append((of.survival, of.survival_std, cuts[0], cuts[1:].std()))
    survival, stds, cuts, cut_stds = np.array(results).T
    assert np.std(survival) == pytest.approx(np.mean(stds), rel=0.15)
    assert np.std(cuts) == pytest.approx(np.mean(cut_stds), rel=0.15)
    within = np.abs(survival - SEP_SURVIVAL) < 2 * stds
    assert 0.91 < within.mean() < 0.99


def test_table_of_a_method_that_agrees_and_one_that_does_not():
    rng = np.random.default_rng(4)
    # the scale of A/E is another: each set has its own cut, and it must not matter
    good = peaks(rng, 3000, 3000, scale=0.9)
    bad = peaks(rng, 3000, 3000) | {"SEP": rng.normal(10, 1, 3000)}
    table = survival_table(data=peaks(rng, 3000, 3000), good=good, bad=bad)
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
    # all of both survive, which no division at random changes
    far = {m: peaks(rng) | {"SEP": np.full(9, 99.0)} for m in ("data", "ren")}
    row = survival_table(**far)["SEP"]
    assert (row.difference["ren"], row.sigma["ren"]) == (0, 0)
    assert row.difference_std["ren"] > 5


def test_table_says_what_does_not_exist():
    rng = np.random.default_rng(6)
    data = peaks(rng) | {"FEP": np.array([])}
    data["DEP"] = np.r_[data["DEP"], np.inf, np.nan]
    few = peaks(rng, n_dep=5) | {"FEP": np.array([9.0, np.nan])}
    table = survival_table(data=data, few=few)
    assert table["DEP"].events == {"data": 800, "few": 5}
    assert table["DEP"].missing == {"data": 2, "few": 0}
    assert table["DEP"].cut["few"] is None
    assert table["SEP"].survival["few"] is None
    assert table["SEP"].sigma["few"] is None
    assert table["SEP"].survival["data"] > 0
    assert table["FEP"].events == {"data": 0, "few": 1}
    assert table["FEP"].missing == {"data": 0, "few": 1}
    assert set(table["FEP"].survival.values()) == {None}
    both = survivals({"SEP": {"data": data["SEP"]}}, {}, {}, {})
    assert "lack peak DEP" in both[0].missing
    assert "no A/E cut" in both[1].missing


def test_a_line_has_the_error_of_its_background_and_that_of_the_fit():
    """Both are added to the error of a peak without them."""
    rng = np.random.default_rng(10)
    sets = {m: peaks(rng, 2000, 2000) for m in ("data", "ren")}
    ae = {peak: {m: of[peak] for m, of in sets.items()} for peak in ("DEP", "SEP")}
    below = rng.normal(9, 1, 1500)
    amplitudes = {m: np.r_[of["SEP"], below] for m, of in sets.items()}
    kev = dict.fromkeys(sets, np.r_[np.full(2000, 2103.0), rng.uniform(2060, 2090, 1500)])
    bands = {"SEP": ((2098.0, 2108.0), [(2060.0, 2090.0)])}
    # both ends of the only axis move the escape peak, and so what survives
    by = {"DEP": np.zeros((1, 2, 1)), "SEP": np.array([0.1, -0.1]).reshape(1, 2, 1)}
    moved = {peak: ae[peak]["ren"] + shift for peak, shift in by.items()}
    plain, fit, line, both = (
        survivals(ae, amplitudes, kev, of, ends)[0]["SEP"]
        for of in ({}, bands)
        for ends in ({}, moved)
    )
    assert fit.of_fit == pytest.approx(100 * 0.1 * 0.38, rel=0.1)
    for name in ("difference_std", "survival_std"):
        for without, row in ((plain, fit), (line, both)):
            error = np.hypot(getattr(without, name)["ren"], fit.of_fit)
            assert getattr(row, name)["ren"] == pytest.approx(error)
    assert line.difference_std["ren"] > plain.difference_std["ren"]
    assert line.events == {"data": 2000, "ren": 2000}


def test_sideband_error_is_the_spread_over_repeated_experiments():
    rng = np.random.default_rng(9)
    results = []
    for _ in range(4000):
        signal, below, n_side = rng.poisson([400, 150, 450])
        survive = rng.random(signal + below) < np.repeat([0.6, 0.2], [signal, below])
        sides = rng.random(n_side) < 0.2
        of = range_survival(1.0 * survive, np.full(3, 0.5), 1.0 * sides, 1 / 3)
        results.append((of.survival, of.survival_std))
    survival, stds = np.array(results).T
    assert survival.mean() == pytest.approx(60, abs=0.3)
    assert survival.std() == pytest.approx(stds.mean(), rel=0.05)


def test_survival_of_a_line_is_that_of_its_own_events():
    rng = np.random.default_rng(8)
    n_line, n_flat = 40_000, 60_000
    energy = np.r_[rng.normal(2103.5, 1, n_line), rng.uniform(2050, 2150, n_flat)]
    amplitude = np.r_[rng.random(n_line) + 0.2, rng.random(n_flat)]
    amplitude[:10] = np.nan
    dep = np.linspace(0.7 - 0.01, 0.7 + 0.09, 2001)  # whose cut lies at 0.7
    bands = {"SEP": ((2098.5, 2108.5), [(2060, 2090), (2117, 2147)])}
    sets = {"DEP": {"data": dep}}, {"data": amplitude}, {"data": energy}
    table, ranges = survivals(*sets, bands)
    of_line = ranges["SEP"]["data"]
    assert of_line.survival == table["SEP"].survival["data"] == pytest.approx(50, abs=1)
    assert of_line.scale == pytest.approx(10 / 60)
    assert of_line.undefined == 10
    in_peak = (energy >= 2098.5) & (energy < 2108.5) & np.isfinite(amplitude)
    assert of_line.peak == in_peak.sum()
    assert of_line.peak_pass == (amplitude[in_peak] >= table["DEP"].cut["data"]).sum()

    # no error is zero where all or none survive, with sidebands without events or none
    for cut, scale in ((0.0, 0.0), (2.0, 0.0), (0.0, 1.0), (2.0, 1.0)):
        few = range_survival(np.ones(8), np.full(3, cut), scale=scale)
        assert 5 < few.survival_std < 15


@pytest.mark.parametrize(
    ("cut", "n", "background", "reason"),
    [
        (0.5, 0, 0, "no events"),
        (np.nan, 3, 0, "there is no cut"),
        (0.5, 3, 1, "the sidebands leave no events of 3"),
    ],
)
def test_without_events_there_is_a_reason(cut, n, background, reason):
    of = range_survival(np.ones(n), np.full(3, cut), np.ones(background), 5.0)
    assert reason in of.missing
    assert of.survival is None


def test_curves_of_survival_are_the_analytic_ones():
    """Of uniform amplitudes a cut that leaves a part p of one leaves 2 p - 1 of the other."""
    single, other = np.linspace(1, 3, 2001), np.linspace(0, 2, 2001)
    unknown = np.append(other, np.nan)
    both = dict.fromkeys(("data", "ren"), single)
    drawn = roc_figure({"SEP": {"data": unknown, "ren": other}, "DEP": both})
    (axes,) = drawn.axes
    assert [line.get_label() for line in axes.lines] == ["Data", "REN translation"]
    for line in axes.lines:
        accepted, left = line.get_data()
        assert left == pytest.approx(np.clip(2 * accepted - 100, 0, 100) / 2, abs=0.2)


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
        continuum = events(rng.uniform(950, 1750, 3000), 0.5, rng)
        amplitude, energy = joined(continuum, line(1587.5, 500, 0.1, rng))
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
