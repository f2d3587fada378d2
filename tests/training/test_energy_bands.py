"""Which pulses of two sets are compared, and with which weights."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cpunet.errors import CpunetError
from cpunet.training import energy_bands as module
from cpunet.training.energy_bands import HEAVIEST, MIN_PULSES, WIDEST, EnergyBand, energy_bands
from synthetic import load_recipe

PEAKS = load_recipe("fast").peaks
FEP = PEAKS["FEP"].energy_kev


def continuum(n: int, low: float, high: float, power: float, seed: int) -> np.ndarray:
    uniform = np.random.default_rng(seed).random(n)
    return low + (high - low) * uniform**power


def test_lines_and_continua_are_kept_apart() -> None:
    sim = np.r_[np.full(300, FEP), continuum(3000, 1000, 1580, 1, 1)]
    data = np.r_[continuum(2000, 1000, 1580, 1, 2), np.full(500, FEP + 1)]
    fep, *others = energy_bands(sim, data, PEAKS)
    assert fep.name == "FEP"
    np.testing.assert_array_equal(fep.sim, np.arange(300))
    np.testing.assert_array_equal(fep.data, np.arange(2000, 2500))
    np.testing.assert_array_equal(fep.weights, 1)
    assert len(others) == 5  # a factor of 1.1 each
    assert sum(len(band.sim) for band in others) == pytest.approx(3000, abs=10)
    assert len(energy_bands(sim[-600:], data[:600], PEAKS)) == 2  # 1.3, where pulses are few


def test_spectra_are_made_alike_within_a_band() -> None:
    sim, data = continuum(20_000, 1000, 1095, 1, 4), continuum(20_000, 1000, 1095, 1.4, 5)
    (band,) = energy_bands(sim, data, {})
    assert band.weights.mean() == pytest.approx(1)
    plain = sim[band.sim].mean() - data[band.data].mean()
    weighted = np.average(sim[band.sim], weights=band.weights) - data[band.data].mean()
    assert abs(weighted) < 0.05 * abs(plain)


@settings(max_examples=25)
@given(
    low=st.floats(100, 1500),
    ratio=st.floats(1.01, 4),
    n=st.integers(MIN_PULSES, 4000),
    share=st.floats(0.3, 3),
    seed=st.integers(0, 99),
)
def test_no_pulse_is_in_two_bands_and_none_is_far_from_its_own(
    low: float, ratio: float, n: int, share: float, seed: int
) -> None:
    sim = continuum(n, low, low * ratio, 1, seed)
    data = continuum(max(MIN_PULSES, int(share * n)), low, low * ratio, 1.5, seed + 1)
    bands, tried = list[EnergyBand](), 0
    while not bands and tried < len(WIDEST):  # wide ones only where there is no narrower one
        widest, tried = WIDEST[tried], tried + 1
        with pytest.MonkeyPatch.context() as patch, suppress(CpunetError):
            patch.setattr(module, "WIDEST", (widest,))
            bands = energy_bands(sim, data, {})
    if not bands:  # the highest ones have no counterpart
        assert min(len(sim), len(data)) < 1.5 * MIN_PULSES
        return
    for own, same in zip(bands, energy_bands(sim, data, {}), strict=True):
        np.testing.assert_array_equal(own.sim, same.sim)
    for side, rows in ((sim, [b.sim for b in bands]), (data, [b.data for b in bands])):
        together = np.concatenate(rows)
        assert len(np.unique(together)) == len(together)
        for of_band in rows:
            assert len(of_band) >= MIN_PULSES
            # but for a rest of the lowest energies, that goes along
            narrow = side[of_band] >= side[of_band].max() / (widest[-1] + 0.01)
            assert narrow.sum() >= len(of_band) - 2 * MIN_PULSES
    for band in bands:
        assert band.weights.shape == band.sim.shape
        assert band.weights.min() >= 0
        assert band.weights.max() <= HEAVIEST / 0.1


def test_few_pulses_of_many_energies_are_one_wide_band() -> None:
    """As of a short run of a source, from a threshold to its highest line."""
    sim, data = continuum(2800, 300, 2600, 1, 1), continuum(317, 300, 2600, 2, 2)
    (band,) = energy_bands(sim, data, PEAKS)
    assert len(band.data) > 300
    assert band.weights.min() < 1 < band.weights.max()


@pytest.mark.parametrize(
    ("sim", "data"),
    [
        (continuum(300, 300, 500, 1, 1), continuum(600, 900, 1500, 1, 2)),
        # energies of a table: all pulses of a line have the same
        (np.full(300, 1100.0), np.r_[np.full(300, 1000.0), np.full(300, 1200.0)]),
    ],
)
def test_spectra_that_do_not_overlap_are_refused(sim, data) -> None:
    with pytest.raises(CpunetError, match=r"^300 simulated and 600 measured pulses; 200 of"):
        energy_bands(sim, data, PEAKS)
