"""A network with noise outside: energies scale it, and it is prepared as data are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_tails import DrawnTails, TraceNoise
from cpunet.electronics.in_trace_pile_up import InTracePileUp
from cpunet.electronics.tails_law import TailsLaw
from cpunet.errors import CpunetError
from cpunet.networks.generators import NOISE_BINS
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe
from cpunet.training.cyclegan import CycleGan
from cpunet.training.outside import Outside
from cpunet.translation.backends import Drawn
from cpunet.translation.translator import REN
from synthetic import write_run

RECIPE = load_recipe("paper", ["training.noise=baselines", "generator.width=2"])
DECAY = torch.exp(-(torch.arange(800) - 400).clamp(min=0) / 1800)
DT_NS, RMS_KEV = 16.0, 6.0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that was not trained."""
    noise = BaselineNoise(np.full(NOISE_BINS, RMS_KEV**2), 2 * (NOISE_BINS - 1), DT_NS, 100)
    outside = Outside(TraceNoise(noise), np.ones(1), RECIPE.preparation)
    torch.manual_seed(0)
    model = CycleGan(RECIPE, outside)
    folder = tmp_path_factory.mktemp("run")
    info = {"recipe": "paper", "peak": "FEP", "seed": 0, "dt_ns": DT_NS}
    drawn = DrawnTails(TailsLaw(2.0, 50.0, (100.0, 2000.0)), 1.0, 0.0, DT_NS)
    fit = {"tails": {"rate_khz": 2.0, "drawn": drawn.describe()}}
    write_run(folder, model, RECIPE, info | {"seconds": 1.0, "device": "cpu", "fit": fit})
    return folder


@pytest.fixture(autouse=True)
def only_a_decay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let networks leave a pulse as it is, but for a decay."""
    monkeypatch.setattr(PositionalUNet, "forward", lambda _, pulses, **_options: pulses * DECAY)


@pytest.fixture(scope="module")
def sim() -> FloatArray:
    width = np.linspace(1.5, 5, 60)[:, np.newaxis]
    pulses = 1 / (1 + np.exp(-(np.arange(225) - 80) / width))
    raw = Pulses.of(pulses, dt_ns=DT_NS)
    return prepare(raw, RECIPE.preparation, "simulated").pulses.waveforms


def test_noise_goes_as_one_over_the_energy(run, sim):
    ren = REN.load(run)
    for kev in (1000.0, 3000.0):
        found = ren.translate(sim, energy_kev=kev, seed=1)
        assert float(found[:, :200].std()) == pytest.approx(RMS_KEV / kev, rel=0.05)
        # and they are prepared: a second preparation finds nothing to do
        again = prepare(Pulses.of(found, dt_ns=DT_NS), RECIPE.preparation, "measured")
        assert len(again) == len(found)
        np.testing.assert_allclose(again.pulses.waveforms, found, atol=2e-6)


def test_other_pulses_are_added_with_the_noise(run, sim):
    ren = REN.load(run)
    assert ren.tails is not None
    energies = {"energy_kev": np.full(len(sim), 2000.0)}
    plain = ren.apply(sim, generator=ren.seeded(1), **energies)
    left = np.full(len(sim), 500.0)
    lifted = ren.apply(sim, generator=ren.seeded(1), tails_kev=left, **energies)
    fall = (lifted - plain)[:, :20].mean() - (lifted - plain)[:, 180:200].mean()
    # 500 keV begin 200 samples before the window and fall within it
    wanted = 0.25 * np.exp(-210 * 0.016 / 50) * -np.expm1(-180 * 0.016 / 50)
    assert fall == pytest.approx(wanted, rel=0.2)
    piled = InTracePileUp(
        len(sim), np.array([4]), np.array([400.0]), np.array([-4000.0]), np.array([0])
    )
    drawn = Drawn(generator=ren.seeded(1), piled=piled, **energies)
    result, _ = ren.apply_with_codes(sim, drawn)
    step = result[4] - plain[4]
    # 0.2 of the height of 1, less by the scale: the tail is higher too
    assert step[180:190].mean() - step[100:110].mean() == pytest.approx(0.17, abs=0.03)
    assert np.array_equal(result[5], plain[5])
    with pytest.raises(CpunetError, match="drawn with electronic noise"):
        ren.apply(sim, noise=False, tails_kev=left, **energies)
