"""The game of generators and critics: gradients, losses, and trainings that can be repeated."""

from __future__ import annotations

import copy
import math
import signal
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
import torch
from torch import nn

from cpunet.errors import CpunetError
from cpunet.networks.generators import LinearInverse, ResponseGenerator
from cpunet.networks.linear_parts import LearnedResponse, SolvedInverse, SolvedResponse
from cpunet.networks.response_layer import padding
from cpunet.training.adversarial import (
    Game,
    Residual,
    adversarial_loss,
    slopes_squared,
    train,
    weighted_l1,
    window_weights,
)
from cpunet.training.network_runs import settle
from cpunet.training.views import RECENT, SHARP, Judge, View, aligned
from games import as_published, game_of, mended, windows
from synthetic import LOSS_NAMES, interrupted_in, load_recipe
from synthetic import same_random_numbers as same_random_numbers

pytestmark = pytest.mark.usefixtures("same_random_numbers")

CPUNET = load_recipe("cpunet")
PREPARATION = CPUNET.preparation
CRITIC = CPUNET.residual.discriminator


def residual(random: bool = True) -> Residual:
    network = Residual(CPUNET.residual.generator, 16.0).eval()
    if random:
        nn.init.normal_(network.unet.outlet.weight, std=0.3)
    return network


def test_a_residual_adds_nothing_at_first_and_moves_with_the_pulse():
    pulses, _ = windows()
    assert not residual(random=False)(pulses).any()
    network = residual()
    change = network(pulses)
    assert change.abs().max() > 1e-3
    assert not change[:, :260].any()  # two microseconds before the half maximum, and more
    later = network(pulses.roll(7, dims=1).index_fill(1, torch.arange(7), 0.0))
    torch.testing.assert_close(later[:, 7:], change[:, :-7])
    torch.testing.assert_close(network(3 * pulses), 3 * change)  # of unit height inside


def test_solved_parts_are_those_of_the_readout():
    chain = ResponseGenerator(load_recipe("fast").matching.generator, 16.0)
    sim, data = windows()
    record = chain.response(sim.numpy())
    level = record[:, padding(16.0)[0] :][:, 795:800].mean(axis=1, keepdims=True) / 0.8
    made = SolvedResponse(chain.response, PREPARATION)(sim)
    np.testing.assert_allclose(made, record / level, atol=2e-6)
    inverse = LinearInverse(800, load_recipe("fast").matching.training)
    rng = np.random.default_rng(0)
    inverse.half_height[...] = 0.45
    inverse.mean_in[:], inverse.mean_out[:] = rng.normal(size=(2, len(inverse.mean_in)))
    inverse.weights[:] = 0.05 * rng.normal(size=inverse.weights.shape)
    np.testing.assert_allclose(SolvedInverse(inverse)(data), inverse(data.numpy()), atol=1e-5)


def test_a_learned_response_is_causal_and_begins_as_two_poles_and_the_decay_of_the_data():
    response = LearnedResponse(PREPARATION, decay=1 / 1800)
    step = torch.zeros(1, 800)
    step[:, 400:] = 1.0
    record = response(step)[0, padding(16.0)[0] + 400 :]
    rise = torch.arange(40) / 3
    wanted = (1 - (1 + rise) * torch.exp(-rise)) * torch.exp(-torch.arange(40) / 1800)
    torch.testing.assert_close(record[:40] / record[60] * wanted[39], wanted, atol=0.03, rtol=0)
    fallen = float((record[399] / record[199]).detach())
    assert fallen == pytest.approx(math.exp(-200 / 1800), rel=2e-3)
    torch.manual_seed(0)
    response.sizes.data.normal_()  # whatever it learns, nothing precedes a step
    early = response(step)[0, : padding(16.0)[0] + 400]
    torch.testing.assert_close(early, torch.zeros_like(early), atol=2e-6, rtol=0)


@pytest.mark.parametrize("moved", ["gain", "shift"])
def test_gradients_of_a_view_are_finite_differences(moved):
    """Gain is divided out; a shift by a part of a sample moves the pulse in its record."""
    _, data = windows()
    data = data.double()
    following = torch.cat([data[:, 1:], data[:, -1:]], dim=1)
    number = torch.tensor(1.0 if moved == "gain" else 0.1).double().requires_grad_()
    along = torch.randn(12, 596, dtype=torch.float64)

    def value() -> torch.Tensor:
        seen = number * data if moved == "gain" else data + number * (following - data)
        return (aligned(seen, PREPARATION) * along).sum()

    (found,) = torch.autograd.grad(value(), number)
    with torch.no_grad():
        apart = [number.add_(step) and value() for step in (1e-5, -2e-5)]
    wanted = (apart[0] - apart[1]) / 2e-5
    assert float(found) == pytest.approx(float(wanted), rel=1e-3, abs=1e-5)
    if moved == "gain":
        assert abs(float(found)) < 1e-6


@pytest.mark.parametrize("side", ["data", "sim"])
def test_views_are_in_units_of_the_spread_and_reach_to_the_end(side):
    sim, data = windows(200)
    real = {"sim": sim, "data": data}[side]
    view = View(side, real, CRITIC, PREPARATION)
    seen = view(real)
    assert seen.shape == (200, view.size)
    numbers = seen[:, -64:]
    if side == "data":  # clean pulses have fewer than 64 components
        torch.testing.assert_close(numbers.std(dim=0), torch.ones(64), atol=0.2, rtol=0)
    late = real.clone()
    late[:, -25:] += 0.02
    assert (view(late) - seen).abs().max() > 0.3


def test_the_losses():
    better, worse = torch.tensor([1.0]), torch.tensor([-0.5])
    paired = float(adversarial_loss(better, worse, paired=True))
    assert paired == pytest.approx(math.log1p(math.exp(-1.5)))
    published = float(adversarial_loss(better, worse, paired=False))
    assert published == pytest.approx(math.log1p(math.exp(-1)) + math.log1p(math.exp(-0.5)))
    losses = load_recipe("published").training.losses
    weights = window_weights(losses, 800)
    apart = torch.zeros(1, 800)
    apart[:, 210] = 0.1  # on the edge, of 250 samples
    assert float(weighted_l1(apart, weights)) == pytest.approx(0.1 * 10 / 250)
    ignoring = weighted_l1(apart, weights, torch.tensor([[0.04]]))
    assert float(ignoring) == pytest.approx(0.06 / 25)
    # the penalty is the squared gradient
    critic = nn.Linear(7, 1)
    found = slopes_squared(lambda x: critic(x)[:, 0], torch.randn(5, 7)).detach()
    assert float(found) == pytest.approx(float(critic.weight.detach().square().sum()), rel=1e-5)


@pytest.mark.parametrize("recipe", [mended, as_published])
@pytest.mark.parametrize("part", ["ren", "iren"])
def test_the_adversarial_loss_alone_reaches_every_parameter_of_a_generator(recipe, part):
    wide = "discriminator.value_range=[-10, 10]", "generator.width=4"
    overrides = () if recipe is mended else wide
    game = game_of(recipe(*overrides))
    for network in game.generators.values():
        if hasattr(network.unet, "unet"):  # its last layer is zero
            nn.init.normal_(network.unet.unet.outlet.weight)
    sim, data = (side.pulses[:4] for side in game.sides[:2])
    both = {"ren": ("data", data, game.ren(sim)), "iren": ("sim", sim, game.iren(data))}
    side, real, fake = both[part]
    game.play(side, part, real, fake)[f"adversarial_{part}"].backward()
    own = game.generators[part]
    still = [n for n, p in own.named_parameters() if p.grad is None or not p.grad.any()]
    assert still == []


@pytest.mark.parametrize("recipe", [mended, as_published])
def test_every_part_of_a_game_moves(recipe):
    game = game_of(recipe("training.discriminator_interval=1"))
    before = copy.deepcopy([game.generators, game.critics])
    losses = game.step()
    assert set(losses) == set(LOSS_NAMES)
    for old, new in zip(before, [game.generators, game.critics], strict=True):
        pairs = zip(old.named_parameters(), new.parameters(), strict=True)
        still = [name for (name, a), b in pairs if torch.equal(a, b)]
        # nothing moves behind a last layer that is zero, and a pair has no common offset
        assert not [n for n in still if "unet.unet" not in n and not n.endswith("outlet.bias")]
    game.step()


def test_critics_see_noise_as_one_over_the_energy_on_both_sides():
    game = game_of(mended())
    rows = torch.arange(9)
    sim = game.sides.sim.pulses[rows]
    rms = (game.sides.noisy(game.ren(sim), rows) - game.ren(sim)).std().detach()
    assert float(rms) == pytest.approx(4.0 / 2000, rel=0.1)
    assert game.with_noise(rows)[:, :200].std() > 1e-4
    assert not game_of(as_published()).sides.noisy(sim, rows).sub(sim).any()


def weights_of(game: Game) -> dict[str, bytes]:
    return {name: v.numpy().tobytes() for name, v in game.average.state_dict().items()}


@pytest.mark.parametrize("recipe", [mended, as_published])
def test_a_resumed_training_ends_with_the_same_bits(recipe):
    records, states, make = [], [], partial(game_of, recipe("training.checkpoint_interval=2"))
    expected = weights_of(train(make, 3, listener=records.extend))
    assert [record["iteration"] for record in records] == [0, 1, 2, 3]
    again = []
    with interrupted_in(3), pytest.raises(KeyboardInterrupt):
        train(make, 3, listener=again.extend, save=lambda s: states.append(copy.deepcopy(s)))
    assert [state["iteration"] for state in states] == [2, 3]
    torch.manual_seed(99)  # what happened in between does not matter
    assert weights_of(train(make, 3, listener=again.extend, start=states[-1])) == expected
    assert again == records


def test_what_is_around_a_training_is_left_alone(caplog):
    caplog.set_level("INFO", "cpunet")
    before, handler, states = torch.get_rng_state(), signal.getsignal(signal.SIGINT), []
    with interrupted_in(1):  # in the last iteration
        train(partial(game_of, as_published("training.iterations=1")), 0, save=states.append)
    assert torch.equal(torch.get_rng_state(), before)
    assert signal.getsignal(signal.SIGINT) is handler
    with interrupted_in(3), pytest.raises(KeyboardInterrupt):
        train(partial(game_of, as_published()), 0, save=states.append)
    assert [state["iteration"] for state in states] == [1, 3]
    assert caplog.messages[-1].startswith("stopped after 3 of 4 iterations")
    with ThreadPoolExecutor(1) as pool:  # which get no signals
        assert pool.submit(train, partial(game_of, as_published()), 0).result().iteration == 4


@pytest.mark.parametrize("bad", ["loss", "weight"])
def test_what_is_not_finite_ends_a_training_and_is_not_kept(monkeypatch, bad):
    step = Game.step

    def diverging(self: Game) -> dict[str, float]:
        losses = step(self)
        if self.iteration == 3 and bad == "weight":
            next(self.average.parameters())[:] = torch.nan
        infinite = {"identity_sim": math.inf} if self.iteration == 3 and bad == "loss" else {}
        return losses | infinite

    monkeypatch.setattr(Game, "step", diverging)
    states, recipe = [], as_published("training.checkpoint_interval=1")
    with pytest.raises(
        CpunetError, match=r"diverged: .* in iteration 2 \(seed 8\); lower"
    ) as error:
        train(partial(game_of, recipe), 8, save=lambda state: states.append(state["iteration"]))
    assert states == [1, 2]
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("own", "accuracy", "done", "how"),
    [
        (0.99, 0.99, 0.6, "won"),
        (0.99, 0.99, 0.4, None),
        (0.8, 0.51, 0.3, "heart"),
        (0.8, 0.51, 0.2, None),
        (0.8, 0.8, 0.9, None),
        (0.53, 0.51, 0.9, None),  # where a game should end
    ],
)
def test_games_that_are_over(caplog, own, accuracy, done, how):
    caplog.set_level("INFO", "cpunet")
    judge = Judge(["data"], unseen=400)
    judge.right["data"] = own
    for _ in range(RECENT):
        judge.note("data", accuracy, done)
    assert judge.over.get("data") == how
    assert len(caplog.messages) == (how is not None)


def test_a_critic_that_has_won_leaves_the_last_good_average():
    game = game_of(as_published("training.held_out=0.3", "training.iterations=50"))
    with torch.no_grad():
        for parameter in game.good.parameters():
            parameter.fill_(7.0)
    game.judge.over["data"] = "won"
    assert train(lambda: game, 0) is game
    assert all(float(p.min()) == 7.0 for p in game.average.parameters())


def moved_by_steps(game: Game, part: str) -> bool:
    """Whether a part of the generators moves in some iterations."""
    before = copy.deepcopy(game.generators.state_dict())
    for _ in range(3):
        game.step()
    after = game.generators.state_dict()
    return any(name.startswith(part) and (after[name] != before[name]).any() for name in after)


def test_a_response_is_learned_from_the_critic_alone():
    # cycles make it too sharp, as its inverse is smooth
    weights = "adversarial_weight=0", "cycle_weight=20"
    game = game_of(mended(*(f"training.losses.{weight}" for weight in weights)))
    assert not moved_by_steps(game, "ren.linear")
    assert moved_by_steps(game, "iren.linear")
    assert moved_by_steps(game_of(mended()), "ren.linear")


def test_a_side_that_is_over_is_not_played_and_ren_does_not_move_unwatched():
    game = game_of(mended())
    game.judge.over["data"] = "heart"
    both = game.critics["data"], game.generators
    critic, generators = (copy.deepcopy(part.state_dict()) for part in both)
    for _ in range(3):
        assert not {"discriminator_data", "adversarial_ren"} & game.step().keys()
    assert all(torch.equal(v, critic[k]) for k, v in both[0].state_dict().items())
    after = both[1].state_dict().items()
    assert {k.split(".")[0] for k, v in after if (v != generators[k]).any()} == {"iren"}


def test_the_highest_currents_of_a_view_are_soft_maxima():
    _, data = windows(40)
    view = View("data", data, mended().discriminator, PREPARATION)
    v = view.aligned(data)
    excess = view.tops(v)[:, 0] - v.diff(dim=1).amax(dim=1) / view.current
    assert excess.min() >= 0
    assert excess.max() < math.log(v.shape[1]) / SHARP


def test_statistics_are_those_of_a_side_without_dropout():
    side = game_of(as_published()).sides.sim
    network = nn.Sequential(nn.Dropout(0.5), nn.BatchNorm1d(64)).eval()
    config = as_published("training.batch_size=11", "training.statistics_batches=200").training
    settle(network, side, config)
    mean = side.pulses.mean(dim=0)
    torch.testing.assert_close(network[1].running_mean, mean, atol=0.02, rtol=0)
    assert network[0].p == 0.5


@pytest.mark.slow
def test_a_step_response_is_learned_from_unpaired_pulses():
    """REN begins 0.04 RMS off on the edge, by its poles."""
    few = "training.iterations=250", "training.held_out=0.1", "discriminator.hidden=32"
    recipe = load_recipe("paper", few)
    game = train(partial(game_of, recipe, n=1500), 0)
    ren, (sim, data) = game.average["ren"], (side.pulses for side in game.sides[:2])
    with torch.no_grad():
        made = aligned(game.sides.prepared(ren(sim)), recipe.preparation)
        apart = made.mean(dim=0) - aligned(data, recipe.preparation).mean(dim=0)
    assert float(apart.square().mean().sqrt()) < 5e-3
