"""Noise outside the generators: discriminators see what a preparation of traces gives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_pile_up import TraceNoise
from cpunet.electronics.finishing import with_room
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Prepared, prepare
from cpunet.training.cyclegan import (
    CycleGan,
    Outside,
    Step,
    as_measured,
    in_room,
    tolerance,
    weighted_l1,
    window_weights,
)
from synthetic import PADDING_BEFORE, load_recipe

CONFIG = load_recipe("paper").preparation
DT_NS, RMS_KEV = 16.0, 4.0
KEV = np.array([500.0, 1000.0, 2000.0, 4000.0])
TINY = (
    "discriminator.embedding_rows=20",
    "discriminator.embedding_dim=4",
    "discriminator.hidden=4",
    "discriminator.samples_per_step=16",
)

Values = dict[str, torch.Tensor]


def slopes(
    function: Callable[[], Values], moved: torch.Tensor, along: torch.Tensor, step: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Derivatives of each value along a direction: by autograd, and by central differences."""

    def values() -> Values:
        torch.manual_seed(1)  # the same noise every time
        return function()

    found, wanted = {}, {}
    for name, value in values().items():
        (slope,) = torch.autograd.grad(value, moved, retain_graph=True, allow_unused=True)
        found[name] = 0.0 if slope is None else float((slope * along).sum())
    with torch.no_grad():
        start = moved.clone()
        sides = []
        for sign in (1, -1):
            moved.copy_(start + sign * step * along)
            sides.append(values())
        moved.copy_(start)
    for name in found:
        wanted[name] = float(sides[0][name] - sides[1][name]) / (2 * step)
    return found, wanted


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


def begin_late(held: list[Prepared]) -> bool:
    """Whether the level of some windows lies in the extension, and of others does not."""
    late = held[0].align_sample > PADDING_BEFORE + CONFIG.samples_before
    return bool(late.any() and not late.all())


def half_time(records: torch.Tensor) -> torch.Tensor:
    """Last crossing of one half before the alignment, by linear interpolation."""
    index = torch.arange(CONFIG.samples_before)
    at = ((records[:, : len(index)] < 0.5) * index).amax(dim=1, keepdim=True)
    low, high = records.gather(1, at), records.gather(1, at + 1)
    return (at + (0.5 - low) / (high - low))[:, 0]


@pytest.mark.parametrize("moved", ["gain", "shift"])
def test_gradients_of_a_view_are_finite_differences(held, moved):
    """Gain is divided out; a shift shifts; neither changes the tail."""
    made = windows(16).double()
    following = torch.cat([made[..., 1:], made[..., -1:] ** 2 / made[..., -2:-1]], dim=2)
    numbers = {"gain": torch.ones(()).double(), "shift": torch.zeros(()).double()}
    number = numbers[moved].requires_grad_()
    outside = outside_of([500.0] * 16)
    direction = torch.randn(16, 1, 800, generator=torch.Generator().manual_seed(0))
    recipe = load_recipe("paper", TINY)  # whose discriminators scale a pulse to 0…1
    torch.manual_seed(0)
    discriminator = CycleGan(recipe).double().eval().discriminator_data

    def views() -> Values:
        early = numbers["shift"]
        translated = numbers["gain"] * ((1 - early) * made + early * following)
        seen = outside.noisy_windows(translated, torch.arange(16))
        time = half_time(seen[:, 0])
        tail = seen[..., -CONFIG.decay_fit_samples :].mean()
        return {
            "windows": (seen * direction).sum(),
            "judged": discriminator(seen).mean(),
            "tail": tail,
            "half": time.mean(),
        }

    found, wanted = slopes(views, number, torch.ones(()), 1e-5)
    assert begin_late(held)
    for name, value in found.items():
        assert value == pytest.approx(wanted[name], rel=1e-2, abs=1e-6), name
    assert abs(found["tail"]) < 2e-3
    assert found["half"] == pytest.approx({"gain": 0.0, "shift": -1.0}[moved], abs=0.1)


def added_to_its_input(forward: Callable[[torch.Tensor], torch.Tensor]):
    return lambda pulses: pulses + forward(pulses)


def test_gradients_of_the_losses_are_finite_differences(held):
    generators = [f"generator.{o}" for o in ("width=2", "dropout=0")]
    heights = "discriminator.value_range=[-1,2]"  # or gains are divided out a second time
    recipe = load_recipe("paper", ["training.noise=baselines", *TINY, *generators, heights])
    outside = outside_of([500.0] * 6)
    torch.manual_seed(0)
    model = CycleGan(recipe, outside).double()
    measured = windows(6).double()
    simulated = measured.roll(1, dims=0) * torch.linspace(0.97, 1.03, 6)[:, None, None]
    with torch.no_grad():
        for network in (model.ren, model.iren):  # nearly the identity, with normal activations
            torch.nn.init.normal_(network.outlet.weight, std=0.003)
            torch.nn.init.zeros_(network.outlet.bias)
            network.forward = added_to_its_input(network.forward)
            for part in network.modules():
                if isinstance(part, torch.nn.BatchNorm1d):
                    part.momentum = 1.0
            network(measured)
    model.eval()
    step = Step(model, recipe.cyclegan.training, outside=outside)

    def losses() -> Values:
        return step.generator_losses(simulated, measured, torch.arange(6))[0]

    parameters = [
        p
        for network in (model.ren, model.iren)
        for p in (network.outlet.weight, network.latent_mean.weight, network.inlet[0].weight)
    ]
    for n, parameter in enumerate(parameters):
        along = torch.randn(parameter.shape, dtype=torch.float64)
        found, wanted = slopes(losses, parameter, along / along.norm(), 1e-6)
        for name, value in found.items():
            assert value == pytest.approx(wanted[name], rel=1e-2, abs=1e-8), (n, name)
    assert begin_late(held)


def test_without_noise_a_window_is_left_as_it_is():
    made = windows()
    found = outside_of(rms_kev=0.0).noisy_windows(made, torch.arange(4))
    torch.testing.assert_close(found, made, atol=2e-6, rtol=0)


def test_noise_goes_as_one_over_the_energy_of_the_pulse_that_it_is_added_to():
    made = windows().expand(4, 1, 800).repeat(64, 1, 1)
    rows = torch.tensor([3, 1, 0, 2]).repeat(64)
    noisy = outside_of().noisy_windows(made, rows)[:, 0, : CONFIG.baseline_samples]
    rms = noisy.reshape(64, 4, -1).square().mean(dim=(0, 2)).sqrt().numpy()
    np.testing.assert_allclose(rms, RMS_KEV / KEV[[3, 1, 0, 2]], rtol=0.05)


def test_the_noise_is_that_of_the_seed():
    drawn = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        drawn.append(outside_of().noisy_windows(windows(), torch.arange(4)))
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])


def test_what_cannot_be_prepared_is_cut_where_it_lies():
    records = 1e-6 * torch.arange(1400.0).expand(2, -1)
    found = as_measured(records, CONFIG, DT_NS)
    assert found.shape == (2, 1, 800)
    assert bool(torch.isfinite(found).all())


def test_a_cycle_is_not_asked_for_noise_but_for_the_pulse():
    weights = window_weights(load_recipe("paper").training.losses, 800)
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
