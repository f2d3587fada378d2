"""Noise before the pulse against noise of known spectrum."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.validation.figures import spectrum_of_noise
from cpunet.validation.noise import baseline_spectra

SAMPLES, DT_NS = 200, 16.0
LATE = 300.0  # sample at which pulses begin that are no concern here


def noise(rng, rms, n=1000):
    return rng.normal(0, rms, (n, 800)).astype(np.float32)


def spectra(windows):
    """Of windows whose pulses all begin late."""
    begins = {method: np.full(len(of_method), LATE) for method, of_method in windows.items()}
    return baseline_spectra(windows, begins, SAMPLES, DT_NS)


def test_bands_add_up_to_the_mean_square_and_a_sine_is_in_its_band():
    white = spectra({"data": noise(np.random.default_rng(1), 3e-3)})["data"]
    # the window's leakage takes the part of the lowest bins that the mean had
    assert sum(white.power) == pytest.approx(9e-6, rel=0.01)
    assert white.rms == pytest.approx(3e-3, rel=0.005)
    time_us = np.arange(800) * DT_NS * 1e-3
    phases = np.random.default_rng(2).uniform(0, 2 * np.pi, 50)
    windows = {"data": 1e-2 * np.sin(2 * np.pi * 5.0 * time_us + phases[:, None])}
    found = spectra(windows)["data"]
    strongest = int(np.argmax(found.power))
    assert found.frequency_mhz[strongest] == pytest.approx(5.0, rel=0.25)
    assert found.rms == pytest.approx(1e-2 / np.sqrt(2), rel=0.01)


def test_equal_noise_agrees_as_often_as_errors_say_and_another_does_not():
    rng = np.random.default_rng(3)
    sets = ({m: noise(rng, 1.0, 60) for m in ("data", "ren")} for _ in range(150))
    sigmas = [spectra(of_set)["ren"] for of_set in sets]
    assert np.std([of.sigma for of in sigmas]) == pytest.approx(1.0, abs=0.15)
    # the worst of many bands is no reason to worry either
    worst = np.array([of.spectrum_sigma for of in sigmas])
    assert np.mean([of.worst_band_sigma > 2 for of in sigmas]) > 0.2
    assert np.mean(worst > 2) < 0.06
    assert np.median(worst) == pytest.approx(0, abs=0.4)
    # noise of another colour and the same size is seen
    white = noise(rng, 1.0, 400)
    slow = white + np.roll(white, 1, axis=1)
    found = spectra({"data": noise(rng, 1.0, 400), "ren": slow / slow.std()})["ren"]
    assert found.rms_ratio == pytest.approx(1, abs=0.01)
    assert found.spectrum_sigma > 10


def with_edges(rng, begins, rms):
    """Noise, and pulses that creep up before they reach 1 % and rise in earnest."""
    since = np.arange(800) - begins[:, np.newaxis]
    crept = 0.01 * np.clip(1 + since / 40, 0, 1) ** 2
    return (noise(rng, rms, len(begins)) + crept + np.clip(since / 60, 0, 1)).astype(np.float32)


def test_pulses_that_begin_early_are_no_noise():
    rng = np.random.default_rng(7)
    # the two sides differ in their drift and not in their noise
    begins = {"data": rng.uniform(160, 250, 800), "ren": rng.uniform(190, 250, 800)}
    begins["data"][:60] = rng.uniform(90, 160, 60)
    windows = {method: with_edges(rng, of, 1e-3) for method, of in begins.items()}
    found = baseline_spectra(windows, begins, SAMPLES, DT_NS)
    assert found["data"].rms == pytest.approx(1e-3, rel=0.02)
    assert abs(found["ren"].sigma) < 3
    assert found["ren"].spectrum_sigma < 3
    assert 90 < found["data"].samples == found["ren"].samples < 120
    # nine of ten, but for those of the stretch's last sample
    assert 720 <= found["data"].n < 740
    begins["ren"][::2] = np.nan  # nothing is known of these
    again = baseline_spectra(windows, begins, SAMPLES, DT_NS)
    assert (found["ren"].n, again["ren"].n) == (800, 400)


def test_too_few_and_unusable_baselines_are_named():
    windows = {m: noise(np.random.default_rng(8), 1.0, 50) for m in ("data", "ren")}
    begins = {"data": np.full(50, 85.0), "ren": np.full(50, LATE)}
    found = baseline_spectra(windows, begins, SAMPLES, DT_NS)
    words = "25 samples before measured pulses begin; 32 are needed"
    assert [found[m].missing for m in ("data", "ren")] == [words, words]
    rng = np.random.default_rng(5)
    broken = noise(rng, 1.0, 12)
    broken[:5] = np.nan
    found = spectra({"data": noise(rng, 1.0), "ren": broken})
    assert found["ren"].missing == "7 baselines; 10 are needed"
    found = spectra({"data": noise(rng, 1.0, 0), "ren": noise(rng, 1.0)})
    assert found["data"].missing
    assert found["ren"].rms_ratio is None


def test_equal_noise_and_none_at_all_are_numbers_and_drawn():
    some, none = noise(np.random.default_rng(10), 1e-3, 50), np.zeros((50, 800), np.float32)
    equal = spectra({"data": some, "ren": some})
    assert (equal["ren"].sigma, equal["ren"].spectrum_sigma) == (0, None)
    silent = spectra({"data": none, "ren": some})
    assert silent["ren"].rms_ratio is None
    for found in (equal, silent, spectra({"data": none, "ren": none})):
        spectrum_of_noise(found, "SEP").canvas.draw()
