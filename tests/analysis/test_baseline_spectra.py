"""Noise before the pulse against noise of known spectrum."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cpunet.analysis.baseline_spectra import baseline_spectra, spectrum_of_noise
from cpunet.errors import CpunetError

SAMPLES, DT_NS = 200, 16.0


def noise(rng, rms, n=1000):
    return rng.normal(0, rms, (n, 800)).astype(np.float32)


def test_bands_add_up_to_the_mean_square_of_white_noise():
    windows = {"data": noise(np.random.default_rng(1), 3e-3)}
    found = baseline_spectra(windows, SAMPLES, DT_NS)["data"]
    # the window's leakage takes the part of the lowest bins that the mean had
    assert sum(found["power"]) == pytest.approx(9e-6, rel=0.01)
    assert found["rms"] == pytest.approx(3e-3, rel=0.005)


def test_a_sine_is_in_its_band():
    time_us = np.arange(800) * DT_NS * 1e-3
    phases = np.random.default_rng(2).uniform(0, 2 * np.pi, 50)
    windows = {"data": 1e-2 * np.sin(2 * np.pi * 5.0 * time_us + phases[:, None])}
    found = baseline_spectra(windows, SAMPLES, DT_NS)
    strongest = int(np.argmax(found["data"]["power"]))
    assert found["frequency_mhz"][strongest] == pytest.approx(5.0, rel=0.25)
    assert found["data"]["rms"] == pytest.approx(1e-2 / np.sqrt(2), rel=0.01)


def test_equal_noise_agrees_as_often_as_errors_say():
    rng = np.random.default_rng(3)
    sigmas = [
        baseline_spectra({m: noise(rng, 1.0, 60) for m in ("data", "ren")}, SAMPLES, DT_NS)[
            "ren"
        ]["sigma"]
        for _ in range(150)
    ]
    assert np.std(sigmas) == pytest.approx(1.0, abs=0.15)


def test_missing_noise_is_seen():
    rng = np.random.default_rng(4)
    windows = {"data": noise(rng, 1e-3), "raw": np.zeros((100, 800), np.float32)}
    found = baseline_spectra(windows, SAMPLES, DT_NS)["raw"]
    assert found["rms_ratio"] == 0
    assert found["sigma"] < -20


def test_too_few_and_unusable_baselines_are_named():
    rng = np.random.default_rng(5)
    broken = noise(rng, 1.0, 12)
    broken[:5] = np.nan
    found = baseline_spectra({"data": noise(rng, 1.0), "ren": broken}, SAMPLES, DT_NS)
    assert found["ren"]["missing"] == "7 baselines; 10 are needed"
    empty = np.empty((0, 800), np.float32)
    found = baseline_spectra({"data": empty, "ren": noise(rng, 1.0)}, SAMPLES, DT_NS)
    assert "missing" in found["data"]
    assert "rms_ratio" not in found["ren"]
    with pytest.raises(CpunetError, match="measured"):
        baseline_spectra({"ren": broken}, SAMPLES, DT_NS)


def test_the_figure_and_the_numbers_can_be_written():
    rng = np.random.default_rng(6)
    found = baseline_spectra({m: noise(rng, 1e-3) for m in ("data", "ren")}, SAMPLES, DT_NS)
    json.dumps(found, allow_nan=False)
    figure = spectrum_of_noise(found, "SEP")
    assert len(figure.axes) == 2
    figure.canvas.draw()
