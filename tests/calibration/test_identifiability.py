"""What is told and what is degenerate, where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.calibration.identifiability import Information, together
from cpunet.calibration.nuisances import named

NUISANCES = tuple(named(name) for name in ("temperature", "hole_velocity_low", "cloud"))
WIDTHS = np.array([n.prior for n in NUISANCES])


def information(jacobian) -> Information:
    return Information(NUISANCES, jacobian.T @ jacobian, WIDTHS, 1000.0)


@pytest.fixture
def alike() -> Information:
    """Temperature and velocity move functions alike, but for a little; the cloud none."""
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(2, 50))
    columns = [30 * one, 30 * one + 0.1 * other, np.zeros(50)]
    return information(np.stack(columns, axis=1) / WIDTHS)


def test_what_moves_pulses_alike_is_one_direction(alike):
    best, second, third = alike.directions()
    assert best.error < 0.01
    assert best.components["temperature_K"] == pytest.approx(0.7, abs=0.05)
    assert best.components["hole_velocity_low_factor"] == pytest.approx(0.7, abs=0.05)
    assert second.error > 0.3
    assert second.components["temperature_K"] * second.components[
        "hole_velocity_low_factor"
    ] == pytest.approx(-0.5, abs=0.05)
    assert third.error == pytest.approx(1)
    assert third.components["cloud_fwhm_mm"] == pytest.approx(1)
    assert best.words.startswith("0.7")


def test_alone_each_is_known_and_together_neither(alike):
    assert alike.errors([0])[0] < 0.01 * WIDTHS[0]
    assert alike.errors()[0] > 0.2 * WIDTHS[0]


@pytest.mark.parametrize(("correlation", "n"), [(-0.99, 1), (0.99, 1), (0.5, 0)])
def test_a_degenerate_pair_is_told_as_its_known_combination(correlation, n):
    covariance = np.eye(3)
    covariance[:2, :2] = 0.64 * np.array([[1, correlation], [correlation, 1]])
    covariance[2, 2] = 0.01
    found = together(["a", "b", "c"], covariance)
    assert len(found) == n
    for pair in found:
        combination = np.array([pair.components["a"], pair.components["b"], 0])
        assert combination @ covariance @ combination == pytest.approx(pair.error**2)
        assert pair.error == pytest.approx(0.8 * 0.1)
    # both known far better than before: two numbers
    assert not together(["a", "b"], 0.01 * covariance[:2, :2])


def test_errors_follow_the_number_of_pulses(alike):
    ratio = alike.errors([0]) / alike.for_pulses(4000).errors([0])
    assert ratio == pytest.approx(2, rel=0.01)
