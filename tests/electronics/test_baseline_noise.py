"""Noise drawn from baselines against noise of a known spectrum."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import finish
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.recipes import load_recipe

CONFIG = load_recipe("paper").preparation
DT_NS = 16.0
ADC_PER_KEV = 15.0
NOISE_KEV = 1.5


def coloured(n: int, length: int, rng: np.random.Generator) -> np.ndarray:
    """Band-limited noise of unit variance: an autoregression with known correlation."""
    white = rng.normal(size=(n, length + 200))
    noise = scipy.signal.lfilter([np.sqrt(1 - 0.8**2)], [1, -0.8], white, axis=1)
    return noise[:, 200:]


def shape(n: int, length: int, start: int = 500) -> np.ndarray:
    time = np.arange(length) - start
    pulse = np.clip(time / 40, 0, 1) * np.exp(-np.maximum(time, 0) * DT_NS / 54_600)
    return np.repeat(pulse[np.newaxis], n, axis=0)


def traces(n: int = 300, seed: int = 0, start: int = 500) -> Pulses:
    """Raw traces in ADC of three energies; every tenth sits on a decaying tail."""
    rng = np.random.default_rng(seed)
    energy = rng.choice([1592.5, 2103.5, 2614.5], n)
    adc = shape(n, 1200, start) * energy[:, np.newaxis]
    adc += NOISE_KEV * coloured(n, 1200, rng)
    adc[::10] += 60 * np.exp(-np.arange(1200) / 1000)
    return Pulses.of(np.round(15_000 + ADC_PER_KEV * adc), dt_ns=DT_NS, energy_kev=energy)


@pytest.fixture(scope="module")
def noise() -> BaselineNoise:
    return BaselineNoise.from_traces(traces(), CONFIG)


def test_noise_has_the_variance_and_correlation_of_the_baselines(noise) -> None:
    energy = np.full(400, 2614.5)
    drawn = noise.draw(energy, 1200, np.random.default_rng(1)) * 2614.5
    # prepared pulses are scaled to 0.8 of a tail that has decayed by 11 %
    scale = 0.8 / np.exp(-397 * DT_NS / 54_600)
    assert drawn.std() == pytest.approx(NOISE_KEV * scale, rel=0.03)
    for lag in (1, 3, 8):
        correlation = (drawn[:, lag:] * drawn[:, :-lag]).mean() / drawn.var()
        assert correlation == pytest.approx(0.8**lag, abs=0.03)
    assert noise.rms == pytest.approx(drawn.std(), rel=0.03)
    assert noise.samples >= 450
    assert 200 < noise.n_baselines <= 275  # not those on a tail


def test_noise_goes_as_one_over_energy(noise) -> None:
    rng = np.random.default_rng(2)
    energy = np.repeat([1000.0, 2000.0], 200)
    width = noise.draw(energy, 800, rng).reshape(2, -1).std(axis=1)
    assert width[0] / width[1] == pytest.approx(2, rel=0.02)


def test_finished_pulses_have_the_noise_of_the_data(noise) -> None:
    records = shape(200, 1200).astype(np.float32)
    windows = finish(
        records, CONFIG, dt_ns=DT_NS, noise=noise, energy_kev=np.full(200, 1592.5), seed=3
    )
    raw = traces(200, seed=8)[:]
    data = finish(raw.waveforms, CONFIG, dt_ns=DT_NS)[raw.energy_kev == 1592.5]
    assert np.isfinite(windows).all()
    assert np.median(windows[:, :200].std(axis=1)) == pytest.approx(
        np.median(data[:, :200].std(axis=1)), rel=0.05
    )
    again = finish(
        records, CONFIG, dt_ns=DT_NS, noise=noise, energy_kev=np.full(200, 1592.5), seed=3
    )
    np.testing.assert_array_equal(windows, again)


def test_bad_input_is_named(noise) -> None:
    with pytest.raises(CpunetError, match="only 0 of 40 traces have a known energy"):
        BaselineNoise.from_traces(Pulses.of(traces(40).waveforms, dt_ns=DT_NS), CONFIG)
    with pytest.raises(CpunetError, match="samples before the pulse; the noise needs 400"):
        BaselineNoise.from_traces(traces(start=380), CONFIG)
    with pytest.raises(CpunetError, match="pulse 1 has an energy of nan keV"):
        noise.draw(np.array([1.0, np.nan]), 100, np.random.default_rng(0))
    records = shape(3, 1200).astype(np.float32)
    with pytest.raises(CpunetError, match="noise for 3 pulses needs 3 energies"):
        finish(records, CONFIG, dt_ns=DT_NS, noise=noise)
    with pytest.raises(CpunetError, match="noise is sampled every 16 ns, the pulses every 8"):
        finish(records, CONFIG, dt_ns=8.0, noise=noise, energy_kev=np.ones(3))
