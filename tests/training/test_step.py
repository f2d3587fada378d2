"""One training step: which gradients flow, what changes, and what the losses are."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cpunet.training.cyclegan import CycleGan, Step, fake_loss, real_loss, window_weights
from synthetic import LOSS_NAMES, load_recipe

pytestmark = [
    pytest.mark.usefixtures("same_random_numbers"),
    # torch's own compiler uses what it deprecates
    pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning"),
]

GENERATOR_LOSSES = LOSS_NAMES[:6]


@pytest.fixture
def batches(sets) -> tuple[Tensor, Tensor]:
    return tuple(torch.from_numpy(pulses[:4])[:, None] for pulses in sets)


def make_step(recipe) -> Step:
    return Step(CycleGan(recipe).train(), recipe.cyclegan.training)


def test_rates_rise_from_zero_where_the_start_is_near(tiny, batches):
    recipe = tiny(
        "generator.width=4", "training.iterations=8", "training.decay_start=4",
        "training.rate_generators=1e-3", "training.rate_discriminators=2e-3",
    )  # fmt: skip
    step = Step(CycleGan(recipe).train(), recipe.cyclegan.training, warmup=4)
    rates = []
    for iteration in range(8):
        rates.append([schedule.get_last_lr()[0] for schedule in step.schedules])
        step(iteration, *batches)
    expected = np.array([0.25, 0.5, 0.75, 1, 1, 0.75, 0.5, 0.25])
    np.testing.assert_allclose(rates, expected[:, None] * [1e-3, 2e-3, 2e-3])


def deterministic(step: Step) -> Step:
    """Without latent noise the losses do not depend on how, and in which order, it is drawn."""
    for network in (step.model.ren, step.model.iren):
        nn.init.zeros_(network.latent_log_variance.weight)
        nn.init.constant_(network.latent_log_variance.bias, -200.0)
    return step


def parameters(module: nn.Module) -> list[Tensor]:
    return [p.detach().clone() for p in module.parameters()]


def changed(before: list[Tensor], module: nn.Module) -> list[bool]:
    return [
        not torch.equal(old, new) for old, new in zip(before, module.parameters(), strict=True)
    ]


@pytest.mark.parametrize("network", ["ren", "iren"])
def test_the_adversarial_loss_alone_reaches_every_generator_parameter(tiny, batches, network):
    # the range must hold whatever an untrained generator puts out
    recipe = tiny("generator.width=4", "discriminator.value_range=[-10, 10]")
    step = make_step(recipe)
    losses, _ = step.generator_losses(*batches)
    losses[f"adversarial_{network}"].backward()
    own = getattr(step.model, network)
    still = [n for n, p in own.named_parameters() if p.grad is None or not p.grad.any()]
    assert still == []
    other = step.model.iren if network == "ren" else step.model.ren
    assert all(p.grad is None for p in other.parameters())


def test_every_discriminator_parameter_learns(tiny, batches):
    step = make_step(tiny())
    discriminators = nn.ModuleList(step.model.discriminators().values())
    before = parameters(discriminators)
    step(0, *batches)
    assert all(p.grad.any() for p in discriminators.parameters())
    assert all(changed(before, discriminators))


def test_discriminators_change_at_their_interval_only(tiny, batches):
    step = make_step(tiny("training.discriminator_interval=3", "training.iterations=20"))
    model = step.model
    for iteration in range(7):
        generators = parameters(model.ren) + parameters(model.iren)
        discriminators = model.discriminators().values()
        before = copy.deepcopy([discriminator.state_dict() for discriminator in discriminators])
        losses = step(iteration, *batches)
        assert all(changed(generators, nn.ModuleList([model.ren, model.iren])))
        for discriminator, old in zip(discriminators, before, strict=True):
            # running statistics too: a generator's step leaves no trace in its discriminator
            same = all(
                torch.equal(old[name], v) for name, v in discriminator.state_dict().items()
            )
            assert same == (iteration % 3 != 0)
        assert set(losses) == set(GENERATOR_LOSSES if iteration % 3 else LOSS_NAMES)


def test_while_judging_only_the_norm_is_in_evaluation(tiny, batches):
    # cuDNN's GRU has a backward pass in training mode only
    step = make_step(tiny("training.discriminator_interval=2"))
    modes: list[tuple[bool, bool]] = []
    discriminator = step.model.discriminator_data
    discriminator.norm.register_forward_hook(
        lambda *_: modes.append((discriminator.gru.training, discriminator.norm.training))
    )
    step(0, *batches)
    step(1, *batches)
    # judged, trained, judged
    assert modes == [(True, False), (True, True), (True, False)]


def l1_by_hand(pulses: Tensor, others: Tensor, losses) -> float:
    """Mean absolute difference per window, times its weight, pulse by pulse."""
    edges = [0, *losses.edges, pulses.shape[-1]]
    weights = (losses.baseline_weight, losses.rising_edge_weight, losses.tail_weight)
    total = 0.0
    for a, b in zip(pulses.detach().numpy()[:, 0], others.numpy()[:, 0], strict=True):
        for weight, first, last in zip(weights, edges[:-1], edges[1:], strict=True):
            differences = [abs(float(a[t]) - float(b[t])) for t in range(first, last)]
            total += weight * sum(differences) / len(differences)
    return total / len(pulses)


def cross_entropy(logits: Tensor, label: int) -> float:
    p = 1 / (1 + np.exp(-logits.detach().double().numpy()))
    return float(-np.mean(np.log(p if label else 1 - p)))


def test_all_losses_of_a_step_by_hand(tiny, batches):
    sim, data = batches
    step = deterministic(make_step(tiny("generator.dropout=0", "training.batch_size=4")))
    model = copy.deepcopy(step.model)
    found = step(0, sim, data)

    weights = step.config.losses
    fake_data, fake_sim = model.ren(sim), model.iren(data)
    expected = {
        "identity_data": l1_by_hand(model.ren(data), data, weights),
        "identity_sim": l1_by_hand(model.iren(sim), sim, weights),
        "cycle_forward": l1_by_hand(model.iren(fake_data), sim, weights),
        "cycle_backward": l1_by_hand(model.ren(fake_sim), data, weights),
    }
    sides = {"data": ("ren", data, fake_data), "sim": ("iren", sim, fake_sim)}
    for side, (generator, real, fake) in sides.items():
        discriminator = getattr(model, f"discriminator_{side}")
        expected[f"adversarial_{generator}"] = cross_entropy(discriminator.eval()(fake), 1)
        logits = discriminator.train()(torch.cat([real, fake]))
        expected[f"discriminator_{side}"] = cross_entropy(logits[:4], 1) + cross_entropy(
            logits[4:], 0
        )
    assert {k: float(v) for k, v in found.items()} == pytest.approx(expected, rel=1e-4)


def test_the_total_is_the_papers_weighted_sum(tiny):
    step = make_step(tiny())
    values = dict(
        zip(GENERATOR_LOSSES, torch.tensor([1.0, 10, 100, 1e3, 1e4, 1e5]), strict=True)
    )
    assert float(step.total(values)) == 5 * (1 + 10) + 20 * (100 + 1000) + 9 * (1e4 + 1e5)


PAPER = load_recipe("paper").training.losses


def test_the_papers_windows():
    weights = window_weights(PAPER, 800)
    assert weights.shape == (800,)
    expected = [3 / 200] * 200 + [10 / 250] * 250 + [7 / 350] * 350
    assert weights.tolist() == pytest.approx(expected)


def test_a_confident_error_is_finite():
    assert float(real_loss(torch.tensor([-1e4]))) == 1e4
    assert float(fake_loss(torch.tensor([1e4]))) == 1e4


def outcome(tiny, sets, *settings: str) -> tuple[Tensor, Tensor]:
    """Translations, and the gradient of the identity losses."""
    recipe = tiny("generator.width=4", "generator.dropout=0", *settings)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        step = deterministic(make_step(recipe))
        losses, fakes = step.generator_losses(
            *(torch.from_numpy(pulses[:8, None]) for pulses in sets)
        )
        (losses["identity_data"] + losses["identity_sim"]).backward()
    gradient = torch.cat([p.grad.flatten() for p in step.model.generator_parameters()])
    return fakes["data"].detach(), gradient


@pytest.mark.slow  # minutes of compiling
@pytest.mark.filterwarnings("ignore")  # torch's compiler warns of what it does itself
def test_a_compiled_pass_is_the_plain_one(tiny, sets):
    for found, expected in zip(
        outcome(tiny, sets, "training.compiled=true"), outcome(tiny, sets), strict=True
    ):
        assert torch.allclose(found, expected, atol=1e-4 * float(expected.abs().max()))


def test_bf16_has_the_direction_of_the_gradient(tiny, sets):
    found, expected = outcome(tiny, sets, "training.precision=bf16"), outcome(tiny, sets)
    assert all(value.dtype == torch.float32 for value in found)
    assert float((found[0] - expected[0]).norm() / expected[0].norm()) < 0.05
    assert torch.cosine_similarity(found[1], expected[1], dim=0) > 0.95
    assert not torch.equal(found[1], expected[1])
