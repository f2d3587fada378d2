"""The inverse of a known readout on synthetic pulses, against the charge that went in."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import finish
from cpunet.errors import CpunetError
from cpunet.networks.generators import LinearInverse, ResponseGenerator
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import prepare
from cpunet.training.inverse import fit_inverse
from synthetic import (
    NOISE_BINS,
    NOISE_SAMPLES,
    PADDING_BEFORE,
    drifting,
    load_recipe,
    two_sites,
    white_noise,
)
from unpaired import crossing

RECIPE = load_recipe("fast", ["generator.poles_ns=[50, 50]", "generator.decay_us=60"])
DT_NS = 16.0
FEP_KEV, DEP_KEV = 2614.5, 1592.5
NOISE_KEV = 3.0


def charge(n: int, seed: int) -> FloatArray:
    """Prepared pulses of one or two sites: slow at first, then a steep end."""
    rng = np.random.default_rng(seed)

    def site() -> np.ndarray:
        drift, steep = rng.uniform(10, 100, (n, 1)), rng.uniform(5, 9, (n, 1))
        return drifting(np.arange(400) - 100 - rng.uniform(0, 1, (n, 1)), drift, steep)

    return as_simulated(Pulses.of(two_sites(rng, n, site), dt_ns=DT_NS).waveforms)


def as_simulated(windows: FloatArray) -> FloatArray:
    pulses = Pulses.of(windows, dt_ns=DT_NS)
    prepared = prepare(pulses, RECIPE.preparation, "simulated")
    assert len(prepared) == len(windows)
    return prepared.pulses.waveforms


def readout(noise_kev: float) -> ResponseGenerator:
    generator = ResponseGenerator(RECIPE.matching.generator, DT_NS)
    generator.set_noise(white_noise(noise_kev))
    return generator


def ren(generator: ResponseGenerator, sim: FloatArray, kev: float | None) -> FloatArray:
    """Windows as the data's, with the noise of an energy or none."""
    how = {"noise": generator.noise, "energy_kev": np.full(len(sim), kev)} if kev else {}
    records = generator(sim)
    windows = finish(records, RECIPE.preparation, dt_ns=DT_NS, seed=5, **how).windows
    assert np.isfinite(windows).all()
    return windows


def half_time(windows: FloatArray) -> np.ndarray:
    """Last interpolated crossing of half the height before the maximum."""
    unit = windows / windows.max(axis=1, keepdims=True)
    return crossing(unit, 0.5, unit.argmax(axis=1))[0]


def at_half(windows: FloatArray) -> np.ndarray:
    """From 200 samples before the half maximum to 150 after it."""
    samples = np.arange(windows.shape[1])
    around = half_time(windows)[:, np.newaxis] + np.arange(-200, 150)
    return np.array([np.interp(t, samples, w) for t, w in zip(around, windows, strict=True)])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def error(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """RMS of each pulse; a second site at half the height may move one's alignment."""
    return np.sqrt(((found - truth) ** 2).mean(axis=1))


def fitted(generator: ResponseGenerator) -> LinearInverse:
    sim = charge(1200, seed=1)
    return fit_inverse(generator, sim, np.full(len(sim), FEP_KEV), RECIPE, seed=0)


@pytest.fixture(scope="module")
def noisy() -> tuple[ResponseGenerator, LinearInverse]:
    generator = readout(NOISE_KEV)
    return generator, fitted(generator)


@pytest.fixture(scope="module")
def held_out() -> FloatArray:
    return charge(300, seed=2)


def test_without_noise_the_charge_comes_back_where_it_was(held_out):
    quiet = readout(0.0)
    inverse, windows, truth = fitted(quiet), ren(quiet, held_out, None), at_half(held_out)
    found = inverse(windows)
    errors = error(at_half(as_simulated(found)), truth)
    assert np.median(errors) < 1e-4
    assert np.quantile(errors, 0.99) < 0.005
    assert error(at_half(windows), truth).min() > 0.02
    delay = half_time(quiet(held_out)) - PADDING_BEFORE - half_time(held_out)
    assert np.quantile(np.abs(half_time(windows) - half_time(found) - delay), 0.95) < 0.02
    later = np.concatenate([windows[:, :1], windows[:, :-1]], axis=1)
    moved = inverse(later)
    np.testing.assert_allclose(moved[:, 1:], found[:, :-1], atol=1e-3)


@pytest.mark.parametrize("kev", [FEP_KEV, DEP_KEV])
def test_noise_is_taken_away_and_the_edge_is_restored(noisy, held_out, kev):
    generator, inverse = noisy
    windows = ren(generator, held_out, kev)
    found, truth = at_half(as_simulated(inverse(windows))), at_half(held_out)
    measured = at_half(windows)
    # no charge has moved 150 samples before any half maximum of these
    assert truth[:, :50].max() == 0
    assert rms(measured[:, :50]) == pytest.approx(NOISE_KEV / kev, rel=0.3)
    assert rms(found[:, :50]) < 0.3 * rms(measured[:, :50])
    # all charge has come 120 samples after it
    assert rms(found[:, 320:] - 1) < 0.3 * NOISE_KEV / kev
    # right before the edge, where charge could have moved, less of it goes
    quiet = (truth == 0) & (np.arange(350) > 100)
    squares = ((values**2).sum(axis=1, where=quiet) for values in (measured, found))
    before, after = (np.median(np.sqrt(of)) for of in squares)
    assert after < 0.75 * before
    unit = measured / measured.max(axis=1, keepdims=True)
    assert np.median(error(found, truth)) < 0.15 * np.median(error(unit, truth))


def test_coloured_noise_is_known_for_what_it_is(held_out):
    generator = readout(0.0)
    frequency = np.linspace(0, 0.5, NOISE_BINS)
    density = 400 / (1 + (frequency / 0.004) ** 2)  # slower than the edge
    generator.set_noise(BaselineNoise(density, NOISE_SAMPLES, DT_NS, 100))
    windows, truth = ren(generator, held_out, FEP_KEV), at_half(held_out)
    # of most pulses: noise at half the height may move the alignment of a few by far
    readouts = generator, readout(generator.noise.rms)
    found = (at_half(fitted(of)(windows)) for of in readouts)
    right, mistaken = (np.median(error(pulses, truth)) for pulses in found)
    assert right < 0.85 * mistaken


def test_few_pulses_are_refused():
    with pytest.raises(CpunetError, match="30 simulated pulses for the inverse"):
        fit_inverse(readout(1.0), charge(30, 1), np.full(30, FEP_KEV), RECIPE, seed=0)
