"""A/E against energy: a known line is found, also where most events have several sites."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.validation.ae_energy import ae_energy_figure, against_energy, site_fit
from cpunet.validation.page import ae_energy_html

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
    amplitude, energy = (np.concatenate(parts) for parts in zip(*sets, strict=True))
    return amplitude, energy


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
        assert not found["multi_site"]
        mean, law = found["methods"]["data"]["mean"], found["methods"]["data"]["resolution"]
        pulls.append((mean["a"] - SLOPE) / mean["a_error"])
        assert mean["a"] * 1592.5 + mean["b"] == pytest.approx(1)
        assert mean["per_mev_percent"] == pytest.approx(1e5 * mean["a"])
        assert mean["chi_square"] < 2.5 * mean["degrees"]
        widths.append([np.sqrt(law["a"] + (law["b"] / e) ** law["c"]) for e in (1000, 1700)])
    assert abs(np.mean(pulls)) < 0.7
    assert 0.6 < np.std(pulls) < 1.5
    expected = np.hypot(WIDTH, NOISE_KEV / np.array([1000, 1700]))
    np.testing.assert_allclose(np.mean(widths, axis=0), expected, rtol=0.08)


def test_a_wide_line_is_no_continuum() -> None:
    rng = np.random.default_rng(1)
    wide = {"DEP": (1560.0, 1625.0)}
    lines = joined(
        events(rng.uniform(*wide["DEP"], 600), 0.1, rng),
        events(rng.uniform(1000, 1500, 3000), 0.4, rng),
    )
    found = against_energy({"data": lines[0]}, {"data": lines[1]}, wide)
    points = found["methods"]["data"]["points"]
    assert wide["DEP"] in [(p["low_kev"], p["high_kev"]) for p in points]


def test_lines_of_many_sites_are_fitted_about_the_single_ones() -> None:
    rng = np.random.default_rng(1)
    shares = {1587.5: 0.1, 2098.5: 0.85, 2609.5: 0.8}
    made = joined(*(line(low, 4000, several, rng) for low, several in shares.items()))
    amplitude, energy = (dict.fromkeys(("data", "ren"), one) for one in made)
    found = against_energy(amplitude, energy, LINES)
    assert found["multi_site"]
    mean = found["methods"]["ren"]["mean"]
    assert mean["a"] == pytest.approx(SLOPE, abs=4 * mean["a_error"])
    assert mean["per_mev_error_percent"] < 0.1
    assert found["methods"]["data"]["scale"] == pytest.approx(SCALE, rel=1e-3)
    assert "REN translation" in ae_energy_html(found, "<figure></figure>")
    axes = ae_energy_figure(found["methods"]).axes
    assert len(axes) == 2
    assert "% per MeV" in axes[0].get_legend().get_texts()[0].get_text()


def test_too_few_events_are_told() -> None:
    rng = np.random.default_rng(2)
    few = line(1587.5, 30, 0.1, rng)
    found = against_energy({"data": few[0]}, {"data": few[1]}, LINES)
    assert "0 ranges" in found["missing"]
    assert "0 ranges" in ae_energy_html(found, "")
    nothing = np.full(500, np.nan)
    assert "missing" in against_energy({"data": nothing}, {"data": 2000 + 0 * nothing}, LINES)
    assert site_fit(np.full(500, 0.1)) is None
