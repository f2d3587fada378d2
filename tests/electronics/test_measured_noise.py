"""Noise from files of raw traces and of prepared windows, against the noise put in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cpunet.electronics.measured import measured_noise, noise_of
from cpunet.errors import CpunetError
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import InputSet
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe

CONFIG = load_recipe("fast").preparation
DT_NS, NOISE_KEV, DECAY_SAMPLES = 16.0, 2.0, 4000.0
# prepared pulses are 0.8 where a step has come down for 397 samples
WANTED = NOISE_KEV * 0.8 / np.exp(-397 / DECAY_SAMPLES)


def traces(n: int = 300, start: int = 560, seed: int = 0) -> Pulses:
    """Raw traces of different energies with white noise of one size in keV."""
    rng = np.random.default_rng(seed)
    energy = rng.uniform(1500, 2700, n)
    time = np.arange(start + 700) - start
    pulse = np.clip(time / 40, 0, 1) * np.exp(-np.maximum(time - 40, 0) / DECAY_SAMPLES)
    kev = energy[:, np.newaxis] * pulse + rng.normal(0, NOISE_KEV, (n, len(time)))
    return Pulses.of(15_000 + 10 * kev, dt_ns=DT_NS, energy_kev=energy)


def as_input(raw: Pulses) -> InputSet:
    prepared, baselines = prepare(raw, CONFIG, "measured"), Baselines.of([raw], CONFIG)
    return InputSet(prepared, DT_NS, Path("raw"), raw.energy_kev, baselines=baselines)


def test_noise_of_raw_traces_needs_no_word() -> None:
    noise, note = measured_noise(as_input(traces()), CONFIG)
    assert note is None
    assert noise.rms == pytest.approx(WANTED, rel=0.03)
    assert noise.n_baselines > 250


def test_energies_that_are_not_known_do_not_matter() -> None:
    raw = traces(400)
    raw.energy_kev[::4] = np.nan
    raw.energy_kev[1::4] = 0
    raw.waveforms[::4] += np.random.default_rng(1).normal(0, 500, raw.waveforms[::4].shape)
    noise = noise_of(as_input(raw))
    assert noise.rms == pytest.approx(WANTED, rel=0.04)
    assert noise.n_baselines <= 200


def test_prepared_windows_fall_back_on_their_beginnings() -> None:
    windows = prepare(traces(), CONFIG, "measured").pulses
    noise, note = measured_noise(as_input(windows), CONFIG)
    assert note is not None
    assert note.startswith(
        f"noise is taken from {CONFIG.baseline_samples // 2} samples a pulse"
    )
    assert "\n" not in note
    assert noise.rms == pytest.approx(WANTED, rel=0.05)
    drawn = noise.draw(np.full(300, 2000.0), 1400, np.random.default_rng(2))
    assert drawn.std() == pytest.approx(WANTED / 2000, rel=0.05)


def test_traces_that_begin_late_fall_back_too() -> None:
    noise, note = measured_noise(as_input(traces(start=380)), CONFIG)
    assert note is not None
    assert "samples before the pulse; the noise needs 400 or more" in note
    assert noise.rms == pytest.approx(WANTED, rel=0.05)


def test_without_energies_there_is_no_noise() -> None:
    raw = Pulses.of(traces(60).waveforms, dt_ns=DT_NS)
    with pytest.raises(CpunetError, match="only 0 flat baselines among 60 traces"):
        measured_noise(as_input(raw), CONFIG)
