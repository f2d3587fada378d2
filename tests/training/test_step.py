"""One training step: which gradients flow, what changes, and what the losses are."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cpunet.training.cyclegan import CycleGan, Step, mean_square_slope, real_loss
from synthetic import LOSS_NAMES

pytestmark = pytest.mark.usefixtures("same_random_numbers")

GENERATOR_LOSSES = LOSS_NAMES[:6]


@pytest.fixture
def batches(sets) -> tuple[Tensor, Tensor]:
    return tuple(torch.from_numpy(pulses[:4])[:, None] for pulses in sets)


def make_step(recipe) -> Step:
    return Step(CycleGan(recipe).train(), recipe.cyclegan.training)


@pytest.mark.thorough
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
    """Without latent noise the losses do not depend on the order of the draws."""
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


def test_the_published_discriminator_lets_all_through_but_the_offset(tiny, batches):
    step = make_step(tiny("generator.width=4"))  # min-max of each pulse: blind to offsets
    losses, _ = step.generator_losses(*batches)
    (losses["adversarial_ren"] + losses["adversarial_iren"]).backward()
    for network in (step.model.ren, step.model.iren):
        largest = {n: float(p.grad.abs().max()) for n, p in network.named_parameters()}
        offset = largest.pop("outlet.bias")
        assert min(largest.values()) > 0
        assert offset < 1e-4 * max(largest.values())


def test_the_adversarial_weight_changes_the_generators_gradients(tiny, batches):
    def gradients(weight: float) -> Tensor:
        torch.manual_seed(1)
        step = make_step(tiny(f"training.losses.adversarial_weight={weight}"))
        losses, _ = step.generator_losses(*batches)
        step.total(losses).backward()
        return torch.cat([p.grad.flatten() for p in step.model.generator_parameters()])

    without, adversarial = gradients(0), gradients(9)
    assert float((adversarial - without).norm() / without.norm()) > 1e-5


@pytest.mark.parametrize("penalty", [0.0, 0.3])
def test_every_discriminator_parameter_learns(tiny, batches, penalty):
    step = make_step(tiny(f"training.losses.gradient_penalty={penalty}"))
    before = [
        parameters(n) for n in (step.model.discriminator_data, step.model.discriminator_sim)
    ]
    step(0, *batches)
    for network, old in zip(
        (step.model.discriminator_data, step.model.discriminator_sim), before, strict=True
    ):
        still = [n for n, p in network.named_parameters() if p.grad is None or not p.grad.any()]
        assert still == []
        assert all(changed(old, network))


def test_discriminators_change_at_their_interval_only(tiny, batches):
    step = make_step(tiny("training.discriminator_interval=3", "training.iterations=20"))
    model = step.model
    for iteration in range(7):
        generators = parameters(model.ren) + parameters(model.iren)
        judges = [model.discriminator_data, model.discriminator_sim]
        before = copy.deepcopy([judge.state_dict() for judge in judges])
        losses = step(iteration, *batches)
        assert all(changed(generators, nn.ModuleList([model.ren, model.iren])))
        for judge, old in zip(judges, before, strict=True):
            # running statistics too: a generator's step leaves no trace in its judge
            same = all(torch.equal(old[name], v) for name, v in judge.state_dict().items())
            assert same == (iteration % 3 != 0)
        assert set(losses) == set(GENERATOR_LOSSES if iteration % 3 else LOSS_NAMES)


def test_after_a_step_all_networks_are_ready_for_the_next(tiny, batches):
    step = make_step(tiny("training.discriminator_interval=2"))
    for iteration in range(2):
        step(iteration, *batches)
        assert all(module.training for module in step.model.modules())
        assert all(p.requires_grad for p in step.model.parameters())


def test_while_judging_only_the_norm_is_in_evaluation(tiny, batches):
    # cuDNN's GRU has a backward pass in training mode only
    step = make_step(tiny("training.discriminator_interval=2"))
    modes: list[tuple[bool, bool]] = []
    judge = step.model.discriminator_data
    judge.norm.register_forward_hook(
        lambda *_: modes.append((judge.gru.training, judge.norm.training))
    )
    step(0, *batches)
    step(1, *batches)
    # judged, trained, judged
    assert modes == [(True, False), (True, True), (True, False)]


def test_discriminator_rates_follow_the_iterations(tiny, batches):
    recipe = tiny(
        "training.iterations=11",
        "training.decay_start=4",
        "training.discriminator_interval=5",
    )
    step = make_step(recipe)
    rates = []
    for iteration in range(11):
        rates.append([o.param_groups[0]["lr"] for o in step.optimisers])
        step(iteration, *batches)
    start = np.array(
        [recipe.training.rate_generators, *2 * [recipe.training.rate_discriminators]]
    )
    expected = np.minimum(1, (11 - np.arange(11)) / 7)[:, None] * start
    np.testing.assert_allclose(rates, expected)
    # their last update, at iteration 10, is taken at 1/7 of the first rate
    assert rates[10][1] == pytest.approx(recipe.training.rate_discriminators / 7)
    assert step.discriminators["data"].param_groups[0]["lr"] == 0


def l1_by_hand(pulses: Tensor, others: Tensor, losses) -> float:
    """Mean absolute difference per window, times its weight, pulse by pulse."""
    edges = np.cumsum([0, losses.baseline_len, losses.rising_edge_len, losses.tail_len])
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
        judge = getattr(model, f"discriminator_{side}")
        expected[f"adversarial_{generator}"] = cross_entropy(judge.eval()(fake), 1)
        logits = judge.train()(torch.cat([real, fake]))
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


@pytest.mark.thorough
def test_the_gradient_penalty_by_finite_differences(tiny, batches):
    sim, data = (b.double() for b in batches)
    judge = CycleGan(tiny()).discriminator_data.double()
    judge.norm.eval()  # so that pulses do not influence each other
    judge.value_range = (-0.5, 1.5)
    pulses = torch.cat([data[:2], sim[:2]]).requires_grad_()
    penalty = mean_square_slope(judge(pulses), pulses)
    squares = 0.0
    for pulse in (*data[:2], *sim[:2]):
        for sample in range(pulse.shape[1]):
            shift = torch.zeros_like(pulse)
            shift[0, sample] = 1e-6
            slope = (judge((pulse + shift)[None]) - judge((pulse - shift)[None])) / 2e-6
            squares += float(slope.detach()) ** 2
    assert float(penalty.detach()) == pytest.approx(squares / 4, rel=1e-3)


def test_judges_see_the_instance_noise_and_it_fades(tiny, batches, monkeypatch):
    sim, data = batches
    recipe = tiny(
        "training.instance_noise=0.3",
        "training.discriminator_interval=1",
        "training.iterations=10",
        "training.decay_start=0",
    )
    step = make_step(recipe)
    seen: list[Tensor] = []
    judge = step.model.discriminator_data
    forward = judge.forward

    def noted(pulses: Tensor) -> Tensor:
        seen.append(pulses.detach())
        return forward(pulses)

    monkeypatch.setattr(judge, "forward", noted)
    for iteration in range(10):
        seen.clear()
        step(iteration, sim, data)
        noise = (seen[1][: len(data)] - data).std()  # seen[0]: of the generators' update
        assert float(noise) == pytest.approx(0.3 * (10 - iteration) / 10, rel=0.25)


@pytest.mark.slow
def test_steps_bring_the_networks_nearer(tiny, batches):
    recipe = tiny("training.iterations=60", "training.decay_start=60", "training.batch_size=4")
    step = make_step(recipe)
    losses = [step(i, *batches) for i in range(60)]
    cycles = [float(x["cycle_forward"] + x["cycle_backward"]) for x in losses]
    assert np.mean(cycles[-10:]) < 0.7 * np.mean(cycles[:10])


def test_a_generator_that_only_listens_to_its_judge_convinces_it(tiny, batches):
    """The published training lacks this: its adversarial losses only rise."""
    sim, _ = batches
    model = CycleGan(tiny("discriminator.value_range=[-10, 10]", "generator.dropout=0"))
    judge = model.discriminator_data.eval().requires_grad_(False)
    optimiser = torch.optim.Adam(model.ren.parameters(), 3e-3)
    losses = []
    for _ in range(30):
        loss = real_loss(judge(model.ren(sim)))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] - 0.01
