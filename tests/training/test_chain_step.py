"""A CycleGAN behind a chain: what cycles compare, where gradients go, the same bits resumed."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_remains import TraceNoise
from cpunet.errors import CpunetError
from cpunet.networks.chain_unet import UNetCorrection
from cpunet.networks.kept_noise import NOISE_BINS
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe
from cpunet.training.chain_step import ChainStep
from cpunet.training.checkpoints import Checkpoint, read_checkpoints, write_checkpoint
from cpunet.training.cyclegan import CycleGan, Step
from cpunet.training.inverse import fit_inverse
from cpunet.training.loop import CheckpointHooks, StoppedError, train
from cpunet.training.network_gate import NetworkGate
from cpunet.training.outside import Outside
from cpunet.training.pairs import Pairs
from cpunet.training.run_folder import write_run
from cpunet.training.sampling import EpochSampler
from cpunet.training.surroundings import MatchedChain, Surroundings
from cpunet.translation.translator import IREN, REN
from derivatives import Values, slopes
from synthetic import SMALL_NETWORK

pytestmark = pytest.mark.thorough

DT_NS, KEV, N = 16.0, 2614.5, 240
RECIPE = load_recipe(
    "small",
    [
        *SMALL_NETWORK,
        "discriminator.embedding_rows=20",
        "discriminator.samples_per_step=16",
        "training.iterations=5",
        "training.decay_start=2",
        "training.batch_size=8",
        "training.statistics_batches=2",
        "training.checkpoint_interval=2",
        "training.pairs.iterations=3",
        "chain.generator.poles_ns=[50]",
        "chain.generator.slow_ns=[]",
        "chain.generator.fast_decays_us=[]",
        "chain.generator.decay_us=60",
    ],
)


@pytest.fixture(scope="module")
def sim() -> Pulses:
    """Prepared charge of one site, of several widths."""
    rng = np.random.default_rng(1)
    width = rng.uniform(1.5, 6, (N, 1))
    pulses = 1 / (1 + np.exp(-(np.arange(225) - rng.uniform(60, 90, (N, 1))) / width))
    raw = Pulses.of(pulses, dt_ns=DT_NS, energy_kev=np.full(N, KEV))
    return prepare(raw, RECIPE.preparation, "simulated").pulses


@pytest.fixture(scope="module")
def surroundings(sim) -> Surroundings:
    """A chain that is right, with white noise, and its inverse."""
    generator = ResponseGenerator(RECIPE.of_chain.matching.generator, DT_NS)
    noise = BaselineNoise(np.full(NOISE_BINS, 4.0), 2 * (NOISE_BINS - 1), DT_NS, 100)
    generator.set_noise(noise)
    energies = np.full(len(sim), KEV)
    inverse = fit_inverse(generator, sim.waveforms, energies, RECIPE.of_chain, seed=0)
    outside = Outside(TraceNoise(noise), energies, RECIPE.preparation)
    return Surroundings(outside, MatchedChain(generator, inverse))


@pytest.fixture(scope="module")
def data(sim, surroundings) -> np.ndarray:
    """The same pulses measured: prepared windows, shape (n, 800)."""
    torch.manual_seed(3)
    step = chain_step(CycleGan(RECIPE, surroundings), surroundings)
    with torch.no_grad():
        records = step.records(torch.from_numpy(sim.waveforms))
        return surroundings.outside.dress(records, torch.arange(len(sim))).windows[:, 0].numpy()


def chain_step(model: CycleGan, surroundings: Surroundings) -> ChainStep:
    return ChainStep(*surroundings.chain, model.ren, model.iren, RECIPE)


def batches(sim, data, n: int = 8) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return (
        torch.from_numpy(sim.waveforms[:n])[:, None],
        torch.from_numpy(data[:n])[:, None],
        torch.arange(n),
    )


def test_before_any_training_the_chain_is_all_there_is(sim, data, surroundings):
    torch.manual_seed(0)
    step = chain_step(CycleGan(RECIPE, surroundings).train(), surroundings)
    waveforms, measured, rows = batches(sim, data)
    with torch.no_grad():
        done = step(waveforms, measured, rows, surroundings.outside)
    for name in ("identity_data", "identity_sim"):
        made, wanted = getattr(done, name)
        torch.testing.assert_close(made, wanted, atol=1e-6, rtol=0)
    # a pulse is compared with itself, where it was moved to: the linear inverse is nearly right
    made, wanted = done.cycle_forward
    assert float((made - wanted).square().mean().sqrt()) < 0.004
    moved = (made - wanted.roll(1, dims=1)).square().mean().sqrt()
    assert float(moved) > 0.006
    made, wanted = done.cycle_backward
    assert float((made - wanted).square().mean().sqrt()) < 0.004
    for side in (done.judged_data, done.judged_sim):
        assert side.real.shape == side.fake.shape == (8, 1, RECIPE.network_length)
        difference = (side.real - side.fake).mean(dim=0).abs()
        assert float(difference.max()) < 0.02


def test_both_judges_reach_the_network_that_they_judge(sim, data, surroundings):
    torch.manual_seed(0)
    model = CycleGan(RECIPE, surroundings).train()
    for network in (model.ren, model.iren):
        torch.nn.init.normal_(network.outlet.weight, std=0.01)
    chain = chain_step(model, surroundings)
    step = Step(model, RECIPE.cyclegan.training, outside=surroundings.outside, chain=chain)
    for network in ("ren", "iren"):
        model.zero_grad()
        losses, _, _ = step.generator_losses(*batches(sim, data))
        losses[f"adversarial_{network}"].backward()
        own = getattr(model, network)
        assert all(p.grad is not None for p in own.parameters())
        assert any(bool(p.grad.any()) for p in own.parameters())
    assert all(p.grad is None for p in model.chain.parameters())


def test_a_training_moves_the_networks_and_not_the_chain(sim, data, surroundings):
    before = copy.deepcopy(surroundings.chain.generator.state_dict())
    model = train(sim.waveforms, data, RECIPE, seed=0, surroundings=surroundings)
    for name, value in model.chain.state_dict().items():
        assert torch.equal(value, before[name])
    assert bool(model.ren.outlet.weight.any())
    assert bool(model.iren.outlet.weight.any())


@pytest.mark.thorough
def test_a_training_that_goes_on_ends_with_the_same_bits(sim, data, surroundings):
    states = []
    hooks = CheckpointHooks(lambda state: states.append(copy.deepcopy(state)))
    sides = (sim.waveforms, data, RECIPE)
    whole = train(*sides, seed=0, surroundings=surroundings, hooks=hooks).state_dict()
    again = CheckpointHooks(lambda _state: None, start=states[0])
    resumed = train(*sides, seed=0, surroundings=surroundings, hooks=again).state_dict()
    assert all(torch.equal(value, resumed[name]) for name, value in whole.items())


def test_stopped_on_pairs_and_resumed_from_a_file(sim, data, surroundings, tmp_path):
    sides, done = (sim.waveforms, data, RECIPE), []
    hooks = CheckpointHooks(
        lambda state: write_checkpoint(tmp_path, Checkpoint(state, {})),
        stop=lambda: len(done) == 2,
        paired=done.append,
    )
    told = "stopped after 2 of 3 iterations on pairs; continue with --resume"
    with pytest.raises(StoppedError, match=told):
        train(*sides, seed=0, surroundings=surroundings, hooks=hooks)
    kept = next(read_checkpoints(tmp_path))
    assert (kept.state["iteration"], kept.state["pairs"]["iteration"]) == (0, 2)
    again = CheckpointHooks(lambda _state: None, kept.state, paired=done.append)
    resumed = train(*sides, seed=0, surroundings=surroundings, hooks=again).state_dict()
    whole = train(*sides, seed=0, surroundings=surroundings).state_dict()
    assert done == [1, 1, 1]
    assert all(torch.equal(value, resumed[name]) for name, value in whole.items())


def test_pairs_that_diverge_are_told_and_not_kept(sim, data, surroundings, monkeypatch):
    def diverge(pairs: Pairs) -> None:
        pairs.iteration += 1
        torch.nn.init.constant_(pairs.model.iren.outlet.bias, float("nan"))

    monkeypatch.setattr(Pairs, "advance", diverge)
    kept = []
    hooks = CheckpointHooks(kept.append, stop=lambda: True)
    told = r"training diverged: iren.outlet.bias is not finite after iteration 0 on pairs"
    with pytest.raises(CpunetError, match=told):
        train(sim.waveforms, data, RECIPE, seed=0, surroundings=surroundings, hooks=hooks)
    assert not kept


def learn(pairs: Pairs) -> None:
    while pairs.left:
        pairs.advance()


@pytest.mark.thorough
def test_pairs_teach_the_inverse_and_leave_ren_alone(sim, surroundings):
    torch.manual_seed(0)
    recipe = RECIPE.model_copy(
        update={
            "training": RECIPE.training.model_copy(
                update={"pairs": RECIPE.training.pairs.model_copy(update={"iterations": 60})}
            )
        }
    )
    model = CycleGan(recipe, surroundings).train()
    before = copy.deepcopy(model.ren.state_dict())
    sampler = EpochSampler(torch.from_numpy(sim.waveforms)[:, None], 8, 0)
    learn(Pairs(model, sampler, recipe, surroundings, chain_step(model, surroundings)))
    assert all(
        torch.equal(value, before[name]) for name, value in model.ren.state_dict().items()
    )
    assert bool(model.iren.outlet.weight.any())


def test_nothing_is_added_where_the_pulse_does_not_move(surroundings):
    torch.manual_seed(0)
    model = CycleGan(RECIPE, surroundings).eval()
    torch.nn.init.normal_(model.ren.outlet.weight, std=1.0)
    matching = RECIPE.of_chain.matching.training
    correction = UNetCorrection(model.ren, matching.before, matching.after, 0.8).eval()
    record = torch.zeros(1, 1400)
    record[:, 600:] = 1.0
    record[:, 590:600] = torch.linspace(0.05, 0.95, 10)
    with torch.no_grad():
        change = (correction(record) - record)[0]
    moves = torch.diff(record[0], prepend=torch.zeros(1)) != 0
    assert bool(change[moves].any())
    assert not bool(change[~moves].any())


def test_gradients_of_the_losses_are_finite_differences(sim, data, surroundings, held):
    surroundings = copy.deepcopy(surroundings)
    model = CycleGan(RECIPE, surroundings)
    torch.manual_seed(0)
    torch.nn.init.normal_(model.ren.outlet.weight, std=10.0)
    torch.nn.init.normal_(model.iren.outlet.weight, std=0.01)
    model.double().eval()
    chain = chain_step(model, surroundings)
    step = Step(model, RECIPE.cyclegan.training, outside=surroundings.outside, chain=chain)
    waveforms, measured, rows = batches(sim, data)

    def losses() -> Values:
        return step.generator_losses(waveforms.double(), measured.double(), rows)[0]

    for network in (model.ren, model.iren):
        parameter = network.outlet.weight
        along = torch.ones_like(parameter)
        found, wanted = slopes(losses, parameter, along, 1e-6)
        for name, value in found.items():
            assert value == pytest.approx(wanted[name], rel=1e-2, abs=1e-7), name


def moving(surroundings: Surroundings) -> CycleGan:
    """Networks whose REN moves samples by a good part of the edge."""
    torch.manual_seed(0)
    model = CycleGan(RECIPE, surroundings).eval()
    torch.nn.init.constant_(model.ren.outlet.bias, 0.0)
    torch.nn.init.normal_(model.ren.outlet.weight, std=3.0)
    return model


@pytest.mark.parametrize("helps", [False, True])
def test_a_network_stays_only_if_held_out_pulses_gain(helps, sim, data, surroundings):
    model = moving(surroundings)
    if helps:  # the data are what it makes
        torch.manual_seed(5)
        step = chain_step(model, surroundings)
        with torch.no_grad():
            records = step.records(torch.from_numpy(sim.waveforms))
            rows = torch.arange(len(sim))
            data = surroundings.outside.dress(records, rows).windows[:, 0].numpy()
    recipe = RECIPE.model_copy(
        update={"training": RECIPE.training.model_copy(update={"held_out": 0.4})}
    )
    gate = NetworkGate(sim.waveforms, data, sim.energy_kev, recipe, seed=0)
    assert len(gate.own) == len(gate.own_data) == 0.6 * N
    kept = gate.judge(model, surroundings.chain)
    assert kept.kept == helps == bool(model.ren.outlet.weight.any())
    assert (kept.held_out_after < kept.held_out_before) == helps
    assert (kept.rms > 0) == helps


@pytest.fixture(scope="module")
def run(sim, data, surroundings, tmp_path_factory):
    model = train(sim.waveforms, data, RECIPE, seed=0, surroundings=surroundings)
    folder = tmp_path_factory.mktemp("run")
    info = {"recipe": "small", "peak": "FEP", "seed": 0, "dt_ns": DT_NS}
    write_run(folder, model, RECIPE, info | {"seconds": 1.0, "device": "cpu"})
    return folder


def test_a_run_translates_there_and_back(run, sim, data):
    ren, iren = REN.load(run), IREN.load(run)
    given = sim.waveforms[:20]
    clean = ren.translate(given, noise=False)
    np.testing.assert_array_equal(clean, ren.translate(given, noise=False))
    noisy = [ren.translate(given, energy_kev=kev, seed=1) for kev in (KEV, KEV / 4)]
    rms = [float(pulses[:, :200].std()) for pulses in noisy]
    assert rms[0] == pytest.approx(2 / KEV, rel=0.15)
    assert rms[1] == pytest.approx(8 / KEV, rel=0.15)
    back = iren.translate(data[:20])
    assert float(np.abs(back - given).mean()) < 0.02
