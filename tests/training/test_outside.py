"""Noise outside the generators: what judges see is what a preparation of noisy traces gives."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_tails import TraceNoise
from cpunet.electronics.finishing import PADDING_BEFORE, with_room
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe
from cpunet.training.cyclegan import CycleGan, Step, weighted_l1, window_weights
from cpunet.training.outside import Outside, as_measured, in_room, tolerance

CONFIG = load_recipe("paper").preparation
DT_NS, RMS_KEV = 16.0, 4.0
KEV = np.array([500.0, 1000.0, 2000.0, 4000.0])


def white(rms_kev: float = RMS_KEV) -> BaselineNoise:
    return BaselineNoise(np.full(513, rms_kev**2), 1024, DT_NS, 100)


def outside_of(energies=KEV, rms_kev: float = RMS_KEV, config=CONFIG) -> Outside:
    return Outside(TraceNoise(white(rms_kev)), np.asarray(energies), config)


def windows(n: int = 4) -> torch.Tensor:
    """Prepared noise-free measured pulses, shape (n, 1, 800)."""
    time = np.arange(1400)
    width = np.linspace(2, 6, n)[:, None]
    pulses = (
        1 / (1 + np.exp(-(time - 560) / width)) * np.exp(-np.clip(time - 560, 0, 1e9) / 4e3)
    )
    prepared = prepare(Pulses.of(pulses, dt_ns=DT_NS), CONFIG, "measured")
    assert len(prepared) == n
    return torch.from_numpy(prepared.pulses.waveforms)[:, None]


def test_gradients_of_noisy_windows_are_finite_differences(held):
    outside, made = outside_of([500.0, 1e5] * 3), windows(6).double().requires_grad_()

    def seen(pulses: torch.Tensor) -> torch.Tensor:
        torch.manual_seed(1)  # the same noise every time
        return outside.dress_windows(pulses, torch.arange(6))

    assert torch.autograd.gradcheck(seen, (made,), fast_mode=True)
    # the level of some windows lies in the extension, and of others does not
    late = held[0].align_sample > PADDING_BEFORE + CONFIG.samples_before
    assert late.any()
    assert not late.all()


def test_noisy_records_become_what_the_preparation_makes_of_them():
    torch.manual_seed(0)
    records = torch.from_numpy(with_room(windows()[:, 0].numpy(), CONFIG, DT_NS))
    records += 0.002 * torch.randn_like(records)
    found = as_measured(records, CONFIG, DT_NS)
    wanted = prepare(Pulses.of(records.numpy(), dt_ns=DT_NS), CONFIG, "measured")
    np.testing.assert_allclose(found[:, 0], wanted.pulses.waveforms, atol=2e-6)


def test_windows_get_the_room_that_they_get_without_gradients():
    made = windows()[:, 0]
    made[0] += 0.01 * torch.randn(800, generator=torch.Generator().manual_seed(0))
    made[1, -20] = -1.0
    torch.testing.assert_close(
        in_room(made, CONFIG),
        torch.from_numpy(with_room(made.numpy(), CONFIG, DT_NS)),
        atol=2e-7,
        rtol=0,
    )


def test_what_cannot_be_prepared_is_cut_where_it_lies():
    records = 1e-6 * torch.arange(1400.0).expand(2, -1)
    found = as_measured(records, CONFIG, DT_NS)
    assert found.shape == (2, 1, 800)
    assert bool(torch.isfinite(found).all())


def test_a_cycle_is_not_asked_for_noise_but_for_the_pulse():
    weights = window_weights(load_recipe("paper").training.losses)
    clean = windows()
    torch.manual_seed(0)
    data = clean + 0.002 * torch.randn_like(clean)
    noise = tolerance(data, CONFIG)
    asked = weighted_l1(clean, data, weights)
    of_clean = weighted_l1(clean, data, weights, noise)
    of_moved = weighted_l1(clean.roll(1, dims=2), data, weights, noise)
    assert of_clean < 0.01 * asked
    assert of_moved > asked


@pytest.mark.parametrize("noise", ["none", "baselines"])
def test_judges_see_noise_if_the_recipe_says_so(noise):
    recipe = load_recipe("paper", [f"training.noise={noise}", "generator.width=2"])
    outside = outside_of([500.0] * 4) if noise == "baselines" else None
    torch.manual_seed(0)
    model = CycleGan(recipe, outside).train()
    with torch.no_grad():  # a generator that leaves its input as it is
        model.ren.forward = lambda pulses, **_: pulses
        model.iren.forward = lambda pulses, **_: pulses
    step = Step(model, recipe.cyclegan.training, outside=outside)
    _, fakes = step.generator_losses(windows(), windows(), torch.arange(4))
    rms = float(fakes["data"][..., :200].std())
    assert rms == pytest.approx(RMS_KEV / 500, rel=0.1) if outside else rms < 1e-3
