"""Chains and networks with noise outside, as translators, against their own numbers."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from cpunet.electronics.drawn_pile_up import DrawnTails, InTracePileUp
from cpunet.errors import CpunetError
from cpunet.networks.generators import KeptNoise
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Rejection, prepare
from cpunet.training.inverse import fit_inverse
from cpunet.translation.translator import IREN, REN
from games import untrained
from synthetic import (
    FACTS,
    after_pole_and_decay,
    in_traces,
    load_recipe,
    sampled,
    two_sites,
    white_noise,
    write_chain,
    write_run,
)

CHAIN = ("generator.poles_ns=[50]", "generator.decay_us=60")
RECIPE = load_recipe("fast", CHAIN)
DT_NS, NOISE_KEV, KEV = 16.0, 3.0, 2000.0
FINE = 16  # samples of the charge to one of the digitiser
N = 40
NOISY = load_recipe("published", ["training.noise=baselines", "generator.width=2"])
DECAY = torch.exp(-(torch.arange(800) - 400).clamp(min=0) / 1800)
RMS_KEV = 6.0


def charge(n: int, seed: int) -> np.ndarray:
    """Charge of two sites with logistic edges, finely sampled."""
    rng = np.random.default_rng(seed)
    time = (np.arange(225 * FINE) + 0.5) / FINE

    def site() -> np.ndarray:
        place, width = rng.uniform(60, 110, (n, 1)), rng.uniform(1.5, 3, (n, 1))
        return 1 / (1 + np.exp(-(time - place) / width))

    return two_sites(rng, n, site, single=0, least=0)


def simulated(n: int, seed: int) -> FloatArray:
    """Charge pulses, long enough and too short to be prepared windows."""
    return sampled(charge(n, seed), FINE).astype(np.float32)


def responded(n: int, seed: int) -> FloatArray:
    """Records of 1200 samples behind a pole of 50 ns and a decay of 60 µs, by recursion."""
    fine = after_pole_and_decay(in_traces(charge(n, seed), FINE), DT_NS / FINE, 50, 60_000)
    return sampled(fine, FINE).astype(np.float32)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has learned the chain and its white noise exactly."""
    raw = Pulses.of(simulated(400, seed=1), dt_ns=DT_NS)
    windows = prepare(raw, RECIPE.preparation, "simulated").pulses.waveforms
    folder, kev = tmp_path_factory.mktemp("run"), np.full(len(windows), KEV)
    inverse = lambda chain: fit_inverse(chain, windows, kev, RECIPE, seed=0)  # noqa: E731
    return write_chain(folder, *CHAIN, noise_kev=NOISE_KEV, inverse=inverse)


@pytest.fixture(scope="module")
def ren(run: Path) -> REN:
    return REN.load(run)


@pytest.fixture(scope="module")
def iren(run: Path) -> IREN:
    return IREN.load(run)


@pytest.fixture(scope="module")
def sim() -> FloatArray:
    return simulated(N, seed=2)


def edge_errors(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """RMS before the alignment, which two ways of rounding may put a sample apart."""
    shifts = [np.roll(found, k, axis=1) - truth for k in (-1, 0, 1)]
    return np.min([np.sqrt((s[:, 300:400] ** 2).mean(axis=1)) for s in shifts], axis=0)


def test_without_noise_pulses_are_those_of_the_chain(ren, iren, sim) -> None:
    traces = responded(N, seed=2)
    truth = prepare(Pulses.of(traces, dt_ns=DT_NS), RECIPE.preparation, "measured")
    assert len(truth) == N
    found = ren.translate(sim, noise=False, seed=1)
    errors = edge_errors(found, truth.pulses.waveforms)
    assert np.median(errors) < 1e-3
    assert errors.max() < 0.01
    # prepared as data: no baseline, and the tail at its level
    assert np.abs(found[:, :200].mean(axis=1)).max() < 1e-6
    np.testing.assert_allclose(found[:, -5:].mean(axis=1), 0.8, atol=1e-5)
    # nothing is random, and energies change nothing
    again = ren.translate(sim, noise=False, seed=2, energy_kev=np.linspace(100, 3000, N))
    np.testing.assert_array_equal(again, found)
    for translator, none in ((ren, np.zeros((0, 225))), (iren, np.zeros((0, 1200)))):
        assert translator.translate(none, energy_kev=np.zeros(0)).shape == (0, 800)


def test_what_cannot_be_translated_is_refused(ren, iren, sim, tmp_path: Path) -> None:
    windows = ren.translate(sim, noise=False)
    for refused in (
        lambda: ren.translate(sim),
        lambda: ren.translate(sim[0]),
        lambda: ren.apply(windows),
    ):
        with pytest.raises(CpunetError, match="give energy_kev, or noise=False"):
            refused()
    for energies in (np.ones(N - 1), np.ones((N, 2))):
        with pytest.raises(CpunetError, match=rf"^energy_kev has shape .* for {N} pulses"):
            ren.translate(sim, energy_kev=energies)
    with pytest.raises(CpunetError, match="leave out tails_kev"):
        iren.translate(responded(5, seed=3), tails_kev=100.0)
    REN.load(write_chain(tmp_path))
    with pytest.raises(CpunetError, match="weights of another network"):
        IREN.load(tmp_path)


def test_pulses_without_energy_are_counted(ren, sim) -> None:
    energies = np.full(N, KEV)
    energies[[1, 4, 6]] = np.nan, 0.0, -5.0
    spoilt = sim.copy()
    spoilt[2] = np.nan
    pulses = Pulses.of(spoilt, dt_ns=DT_NS, energy_kev=energies)
    done = ren.translate_pulses(pulses, generator=np.random.default_rng(1))
    wanted = np.full(N, Rejection.ACCEPTED)
    wanted[[1, 4, 6]], wanted[2] = Rejection.ENERGY_UNKNOWN, Rejection.NAN
    assert done.codes.tolist() == wanted.tolist()
    assert np.isnan(done.pulses.waveforms[~done.valid]).all()
    assert np.isfinite(done.pulses.waveforms[done.valid]).all()
    # energies stay with their pulses, those that were left out in between or not
    good = np.flatnonzero(done.valid)
    alone = ren.translate_pulses(pulses[good], generator=np.random.default_rng(1))
    np.testing.assert_array_equal(alone.pulses.waveforms, done.pulses.waveforms[good])
    without = ren.translate_pulses(pulses, noise=False)
    assert without.codes.tolist() == np.where(np.arange(N) == 2, Rejection.NAN, 0).tolist()


def test_the_inverse_gives_the_charge_back(ren, iren, sim) -> None:
    charge = prepare(Pulses.of(sim, dt_ns=DT_NS), RECIPE.preparation, "simulated")
    truth = charge.pulses.waveforms

    def errors(pulses: FloatArray) -> np.ndarray:
        """RMS about the rise, where half of the height is at the same sample."""
        half, wanted = ([np.flatnonzero(p < 0.5)[-1] for p in of] for of in (pulses, truth))
        shifts = np.subtract(wanted, half)
        moved = np.array([np.roll(p, k) for p, k in zip(pulses, shifts, strict=True)])
        return np.sqrt(((moved - truth)[:, 250:500] ** 2).mean(axis=1))

    back = iren.translate(ren.translate(sim, energy_kev=KEV, seed=1))
    measured = ren.translate(sim, noise=False)
    assert np.median(errors(back)) < 0.02
    raw = errors(measured / measured.max(axis=1, keepdims=True))
    assert np.median(errors(back)) < 0.2 * np.median(raw)
    # prepared as simulated pulses are
    assert np.abs(back.min(axis=1)).max() < 1e-6
    np.testing.assert_allclose(back.max(axis=1), 1, atol=1e-6)


@pytest.fixture(scope="module")
def noisy_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that was not trained."""
    kept = KeptNoise(DT_NS)
    kept.set_noise(white_noise(RMS_KEV))
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("run")
    drawn = DrawnTails(2.0, 50.0, (100.0, 2000.0), 1.0, 0.0, DT_NS)
    fit = {"tails": {"rate_khz": 2.0, "drawn": asdict(drawn)}}
    parts = untrained(NOISY) | {"noise": kept}
    write_run(folder, parts, NOISY, FACTS | {"fit": fit})
    return folder


@pytest.fixture(autouse=True)
def only_a_decay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let networks leave a pulse as it is, but for a decay."""
    monkeypatch.setattr(PositionalUNet, "forward", lambda _, pulses, **_options: pulses * DECAY)


@pytest.fixture(scope="module")
def prepared_sim() -> FloatArray:
    width = np.linspace(1.5, 5, 60)[:, np.newaxis]
    pulses = 1 / (1 + np.exp(-(np.arange(225) - 80) / width))
    raw = Pulses.of(pulses, dt_ns=DT_NS)
    return prepare(raw, NOISY.preparation, "simulated").pulses.waveforms


def test_noise_goes_as_one_over_the_energy(noisy_run, prepared_sim):
    ren = REN.load(noisy_run)
    for kev in (1000.0, 3000.0):
        found = ren.translate(prepared_sim, energy_kev=kev, seed=1)
        assert float(found[:, :200].std()) == pytest.approx(RMS_KEV / kev, rel=0.05)
        # and they are prepared: a second preparation finds nothing to do
        again = prepare(Pulses.of(found, dt_ns=DT_NS), NOISY.preparation, "measured")
        assert len(again) == len(found)
        np.testing.assert_allclose(again.pulses.waveforms, found, atol=2e-6)


def test_other_pulses_are_added_with_the_noise(noisy_run, prepared_sim):
    ren, n = REN.load(noisy_run), len(prepared_sim)
    left = np.full(n, 500.0)

    def windows(**how):
        kev = np.full(n, 2000.0)
        seeded = np.random.default_rng(1)
        return ren.apply(prepared_sim, energy_kev=kev, generator=seeded, **how)

    plain, lifted = windows(), windows(tails_kev=left)
    fall = (lifted - plain)[:, :20].mean() - (lifted - plain)[:, 180:200].mean()
    # 500 keV begin 200 samples before the window and fall within it
    wanted = 0.25 * np.exp(-210 * 0.016 / 50) * -np.expm1(-180 * 0.016 / 50)
    assert fall == pytest.approx(wanted, rel=0.2)
    rows = np.array([4])
    piled = InTracePileUp(n, rows, np.array([400.0]), np.array([-4000.0]), np.array([0]))
    result = windows(piled=piled)
    step = result[4] - plain[4]
    # 0.2 of the height of 1, less by the scale: the tail is higher too
    assert step[180:190].mean() - step[100:110].mean() == pytest.approx(0.17, abs=0.03)
    assert np.array_equal(result[5], plain[5])
    with pytest.raises(CpunetError, match="drawn with electronic noise"):
        windows(noise=False, tails_kev=left)
