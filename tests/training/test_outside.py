"""Noise outside the generators: what judges see is what a preparation of noisy traces gives."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_remains import TraceNoise
from cpunet.electronics.extension import PADDING_BEFORE, with_room
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe
from cpunet.training.cyclegan import CycleGan, Step
from cpunet.training.losses import weighted_l1, window_weights
from cpunet.training.outside import Outside, as_measured, tolerance
from cpunet.training.surroundings import Surroundings

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


def test_noisy_records_become_what_the_preparation_makes_of_them():
    torch.manual_seed(0)
    records = torch.from_numpy(with_room(windows()[:, 0].numpy(), CONFIG, DT_NS))
    records += 0.002 * torch.randn_like(records)
    found = as_measured(records, CONFIG, DT_NS)
    wanted = prepare(Pulses.of(records.numpy(), dt_ns=DT_NS), CONFIG, "measured")
    np.testing.assert_allclose(found.windows[:, 0], wanted.pulses.waveforms, atol=2e-6)
    assert found.start.tolist() == (wanted.align_sample - CONFIG.samples_before).tolist()


def test_gradients_pass_through_noise_and_preparation():
    made = windows().requires_grad_()
    outside_of().dress_windows(made, torch.arange(4)).square().sum().backward()
    assert bool((made.grad != 0).any(dim=2).all())


def test_without_noise_a_window_is_left_as_it_is():
    made = windows()
    found = outside_of(rms_kev=0.0).dress_windows(made, torch.arange(4))
    torch.testing.assert_close(found, made, atol=2e-6, rtol=0)


def test_noise_goes_as_one_over_the_energy_of_the_pulse_that_it_is_added_to():
    made = windows().expand(4, 1, 800).repeat(64, 1, 1)
    rows = torch.tensor([3, 1, 0, 2]).repeat(64)
    noisy = outside_of().dress_windows(made, rows)[:, 0, : CONFIG.baseline_samples]
    rms = noisy.reshape(64, 4, -1).square().mean(dim=(0, 2)).sqrt().numpy()
    np.testing.assert_allclose(rms, RMS_KEV / KEV[[3, 1, 0, 2]], rtol=0.05)


def test_the_noise_is_that_of_the_seed():
    drawn = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        drawn.append(outside_of().dress_windows(windows(), torch.arange(4)))
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])


def test_what_cannot_be_prepared_is_cut_where_it_lies():
    found = as_measured(torch.zeros(2, 1400), CONFIG, DT_NS)
    assert found.start.tolist() == [PADDING_BEFORE, PADDING_BEFORE]
    assert bool(torch.isfinite(found.windows).all())


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
    model = CycleGan(recipe, Surroundings(outside)).train()
    with torch.no_grad():  # a generator that leaves its input as it is
        model.ren.forward = lambda pulses, **_: pulses
        model.iren.forward = lambda pulses, **_: pulses
    step = Step(model, recipe.cyclegan.training, outside=outside)
    _, judged, _ = step.generator_losses(windows(), windows(), torch.arange(4))
    rms = float(judged.fake[..., :200].std())
    assert rms == pytest.approx(RMS_KEV / 500, rel=0.1) if outside else rms < 1e-3


def test_paper_noise_differs_from_paper_in_nothing_but_the_noise():
    own, twin = (load_recipe(n).model_dump(mode="json") for n in ("paper", "paper-noise"))
    for settings in (own, twin):
        del settings["name"], settings["description"]
    assert (own["training"].pop("noise"), twin["training"].pop("noise")) == (
        "none",
        "baselines",
    )
    assert own == twin
