"""Noise drawn from baselines, and measured in files, against noise of a known spectrum."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.fft
import scipy.signal

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.chain import read_electronics
from cpunet.electronics.finishing import finish
from cpunet.electronics.measured import noise_of
from cpunet.electronics.readout import coloured_noise, noise_power
from cpunet.errors import CpunetError
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import InputSet
from cpunet.pulses.preparation import prepare
from synthetic import load_recipe

CONFIG = load_recipe("paper").preparation
DT_NS = 16.0
ADC_PER_KEV, NOISE_KEV = 15.0, 1.5
# Prepared pulses are scaled to 0.8 of a tail that has decayed by 11 %.
TO_PREPARED = 0.8 / np.exp(-397 * DT_NS / 54_600)
GRID, SPECTRUM = 8192, read_electronics("legend200").noise.spectrum
FAST = load_recipe("fast").preparation
WANTED = NOISE_KEV * TO_PREPARED


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
    return BaselineNoise.of(Baselines.of([traces()], CONFIG))


def test_noise_has_the_variance_and_correlation_of_the_baselines(noise) -> None:
    energy = np.full(400, 2614.5)
    drawn = noise.draw(energy, 1200, np.random.default_rng(1)) * 2614.5
    assert drawn.std() == pytest.approx(WANTED, rel=0.03)
    for lag in (1, 3, 8):
        correlation = (drawn[:, lag:] * drawn[:, :-lag]).mean() / drawn.var()
        assert correlation == pytest.approx(0.8**lag, abs=0.03)
    assert noise.rms == pytest.approx(drawn.std(), rel=0.03)
    assert noise.samples >= 450
    assert 200 < noise.n_baselines <= 275  # not those on a tail


def test_the_error_of_the_rms_covers_the_truth() -> None:
    sets = (traces(100, seed) for seed in range(20, 40))
    found = [BaselineNoise.of(Baselines.of([raw], CONFIG)) for raw in sets]
    errors = np.array([noise.rms_error for noise in found])
    pulls = (np.array([noise.rms for noise in found]) - WANTED) / errors
    assert np.median(errors) < 0.03 * WANTED
    assert 0.5 < np.sqrt((pulls**2).mean()) < 1.5


def test_pulses_finished_without_noise_and_with_it_at_once(noise) -> None:
    records = shape(600, 1200).astype(np.float32)
    records[3] = 0  # cannot be prepared
    kev = np.full(600, 1592.5)
    noisy, _, clean, _ = finish(records, CONFIG, dt_ns=DT_NS, noise=noise, energy_kev=kev)
    np.testing.assert_array_equal(clean, finish(records, CONFIG, dt_ns=DT_NS).windows)
    assert np.isnan(noisy[3]).all()


def test_bad_input_is_named(noise) -> None:
    for raw in (Pulses.of(traces().waveforms, dt_ns=DT_NS), traces(start=130)):
        with pytest.raises(CpunetError, match="only 0 of 300 traces have a known energy and"):
            BaselineNoise.of(Baselines.of([raw], CONFIG))
    with pytest.raises(CpunetError, match="pulse 1 has an energy of nan keV"):
        noise.draw(np.array([1.0, np.nan]), 100, np.random.default_rng(0))


def on_baselines(baselines: np.ndarray, kev: float = 2000.0) -> Pulses:
    """Raw traces of one energy with these baselines, in keV, under the pulses too."""
    energy = np.full(len(baselines), kev)
    adc = ADC_PER_KEV * (kev * shape(len(baselines), baselines.shape[1], 560) + baselines)
    return Pulses.of(15_000 + adc, dt_ns=DT_NS, energy_kev=energy)


def test_noise_slower_than_a_baseline_is_found() -> None:
    baselines = 2 * coloured_noise(SPECTRUM, 1500, 1200, DT_NS, np.random.default_rng(6))
    noise = BaselineNoise.of(Baselines.of([on_baselines(baselines)], CONFIG))
    assert noise.n_baselines > 1000
    assert noise.rms == pytest.approx(2 * TO_PREPARED, rel=0.1)
    drawn = noise.draw(np.ones(1500), 1200, np.random.default_rng(7)) / TO_PREPARED
    # mean square differences within a baseline, of some 500 samples, and twice as far apart
    for apart, tolerance in ((4, 0.05), (100, 0.05), (400, 0.07), (1100, 0.15)):
        drifts = [((x[:, apart:] - x[:, :-apart]) ** 2).mean() for x in (drawn, baselines)]
        assert drifts[0] == pytest.approx(drifts[1], rel=tolerance)
    # all the power below a baseline's lowest frequency, 125 kHz
    power = noise_power(SPECTRUM, DT_NS, GRID)
    frequency_mhz = scipy.fft.rfftfreq(GRID, DT_NS * 1e-3)
    slow = (frequency_mhz > 0) & (frequency_mhz < 0.125)
    found = 2 * noise.density_of(GRID)[slow].sum() / GRID / TO_PREPARED**2
    # no baseline shows it: a guess from how they drift
    assert found == pytest.approx(4 * power[slow].sum(), rel=0.5)


def test_a_line_is_a_sine_of_its_height() -> None:
    rng = np.random.default_rng(9)
    phase = rng.uniform(0, 2 * np.pi, (800, 1))
    line = 3 * np.sin(2 * np.pi * 0.11 * np.arange(1200) + phase)
    baselines = line + rng.normal(size=(800, 1200))
    noise = BaselineNoise.of(Baselines.of([on_baselines(baselines)], CONFIG))
    drawn = noise.draw(np.ones(800), 1200, np.random.default_rng(10)) / TO_PREPARED
    assert drawn.std() == pytest.approx(np.sqrt(4.5 + 1), rel=0.05)
    wave = np.exp(-2j * np.pi * 0.11 * np.arange(400))
    heights = 2 * np.abs(drawn[:, :400] @ wave) / 400
    assert np.median(heights) == pytest.approx(3, rel=0.07)
    # Gaussian noise in a narrow band is twice as often low as high
    assert heights.std() < 0.15 * heights.mean()
    for samples in (3000, 6000, 8192):  # a line of two bins would beat
        rms = noise.draw(np.ones(40), samples, np.random.default_rng(3)).std(axis=1)
        assert np.ptp(rms) < 0.1 * rms.mean()


def test_baselines_of_different_kinds_are_drawn_as_such() -> None:
    """Also if they are few: small kinds are not drawn with what all have in common."""
    rng, n = np.random.default_rng(11), 300
    heights = np.exp(rng.normal(0, 0.3, n))
    raw = on_baselines(heights[:, np.newaxis] * rng.normal(size=(n, 1200)))
    noise = BaselineNoise.of(Baselines.of([raw], CONFIG))
    drawn = noise.draw(np.ones(1500), 1200, np.random.default_rng(12)) / TO_PREPARED
    width = np.log(drawn.std(axis=1))
    assert np.median(width) == pytest.approx(0, abs=0.1)
    # one spectrum for all would leave 1/sqrt(2 x 1200) of it, 0.02
    assert width.std() == pytest.approx(0.3, rel=0.25)


def test_noise_has_the_power_of_baselines_of_which_some_are_quiet() -> None:
    """Also where the noise falls towards low frequencies, and in each set that is drawn."""
    rng, n, length, used = np.random.default_rng(3), 2000, 1200, 500
    frequency = np.fft.rfftfreq(8 * length)
    size = 1 / np.hypot(1, (frequency - 0.006) / 0.003)
    bins = size * rng.standard_normal((n, 2 * len(size))).view(complex)
    baselines = 40 * np.fft.irfft(bins, 8 * length)[:, :length]
    baselines[: n // 20] *= 0.3
    noise = BaselineNoise.of(Baselines.of([on_baselines(baselines)], CONFIG))
    assert noise.n_baselines > 0.98 * n
    drawn = (noise.draw(np.ones(n), used, np.random.default_rng(seed)) for seed in range(5))
    power = [of.var(axis=1).mean() for of in drawn]
    ratios = np.array(power) / TO_PREPARED**2 / baselines[:, :used].var(axis=1).mean()
    assert ratios == pytest.approx(1, abs=0.02)


def test_what_has_no_noise_or_no_energy_is_left_out() -> None:
    baselines = np.random.default_rng(5).normal(size=(1000, 1200))
    baselines[::20] = 0
    baselines[1::20] *= 500
    raw = on_baselines(baselines)
    raw.energy_kev[1::20] = np.nan
    raw.energy_kev[2::20] = 0
    noise = noise_of(as_input(raw))
    assert noise.n_baselines <= 850
    assert noise.rms / TO_PREPARED == pytest.approx(1, abs=0.02)
    with pytest.raises(CpunetError, match="most baselines are constant"):
        BaselineNoise.of(Baselines.of([on_baselines(0 * baselines[:100])], CONFIG))


def as_input(raw: Pulses) -> InputSet:
    prepared, baselines = prepare(raw, FAST, "measured"), Baselines.of([raw], FAST)
    recipe = load_recipe("fast")
    return InputSet(prepared, DT_NS, Path("raw"), raw.energy_kev, recipe, baselines=baselines)


@pytest.mark.parametrize("start", [560, 300, 240])
def test_short_baselines_tell_the_noise(start: int) -> None:
    noise = noise_of(as_input(traces(1200, start=start)))
    assert noise.rms == pytest.approx(WANTED, rel=0.03 if start == 560 else 0.05)
    assert noise.n_baselines > 1000
    windows = prepare(traces(), FAST, "measured").pulses
    assert noise_of(as_input(windows)).rms == pytest.approx(WANTED, rel=0.05)
