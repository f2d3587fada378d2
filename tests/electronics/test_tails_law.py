"""The law of what earlier pulses leave, against pulses drawn one by one."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.electronics.tails_fit import fit_rate
from cpunet.electronics.tails_law import (
    TailsLaw,
    characteristic_exponents,
    energies_at,
)
from cpunet.errors import CpunetError

TH228 = (10, 60, 85, 155, 235, 240, 365, 560, 720, 1980, 2615)


def test_share_above_is_the_closed_form():
    law = TailsLaw(2.0, 50.0, (100, 100))
    expected = 1 - np.exp(-0.1 * np.log([100, 10, 1]))
    assert law.share_above([1, 10, 100]) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("rate_khz", [0.3, 3.0])
def test_drawn_tails_have_the_characteristic_function_of_the_law(rate_khz: float):
    law = TailsLaw(rate_khz, 54.6, TH228)
    drawn = law.draw(100_000, np.random.default_rng(1))
    assert drawn.mean() == pytest.approx(law.mean_kev, rel=0.1)
    u = np.geomspace(1e-3, 0.5, 10)
    energies = energies_at((np.arange(1000) + 0.5) / 1000, TH228)
    wanted = np.exp(law.expected * characteristic_exponents(u, energies).mean(axis=1))
    found = np.exp(1j * u[:, np.newaxis] * drawn).mean(axis=1)
    np.testing.assert_allclose(found, wanted, atol=0.01)  # three errors of either part


def test_energies_follow_their_quantiles():
    drawn = energies_at(np.random.default_rng(2).random(20_000), TH228)
    assert np.quantile(drawn, np.linspace(0, 1, 11)) == pytest.approx(TH228, rel=0.05)


@pytest.mark.parametrize("error_kev", [pytest.param(0.3, marks=pytest.mark.thorough), 3.0])
def test_the_rate_is_found_with_little_and_with_much_noise(error_kev: float):
    law, rng = TailsLaw(1.5, 54.6, TH228), np.random.default_rng(3)
    energies = energies_at(rng.random(8000), TH228)
    measured = law.draw(8000, rng) + rng.normal(0, error_kev, 8000)
    found = fit_rate(measured, error_kev, 54.6, energies)
    assert found.recorded
    assert found.law.rate_khz == pytest.approx(1.5, abs=3 * found.rate_error_khz)
    assert found.sigma_kev == pytest.approx(error_kev, rel=0.05)


def test_too_many_earlier_pulses_are_refused_before_they_fill_the_memory():
    endless = TailsLaw(0.02, 1e12, TH228)
    with pytest.raises(CpunetError, match="give a lower rate or a shorter decay"):
        endless.draw(1000, np.random.default_rng(1))
