"""Two processes that train together give what one gives with batches of twice the size.

One start of two processes does all the work of this module; the tests compare what they found.
"""

from __future__ import annotations

import copy
import json
import os
import runpy
import socket
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cpunet.errors import CpunetError
from cpunet.recipes import load_recipe
from cpunet.training.cyclegan import LOSS_NAMES, CycleGan, Step
from cpunet.training.group_norm import GroupBatchNorm, share_norms
from cpunet.training.group_state import require_same_everywhere, share_state
from cpunet.training.loop import CheckpointHooks, StoppedError, train
from cpunet.training.process_group import (
    ALONE,
    ProcessGroup,
    ToldElsewhereError,
    launch,
    meeting,
)
from cpunet.training.sampling import EpochSampler
from synthetic import small_sides

SIZE = 2
PROCESS = "one of a group"  # the name of this module in a process of a group
STEPS = 3
PENALTIES = (0.0, 0.3)
SHORT = ("training.iterations=2", "training.log_interval=1", "training.statistics_batches=1")
QUIET = ("generator.dropout=0.0", "training.instance_noise=0.0")
CLIPPED = ("training.max_grad_norm=0.5", "training.discriminator_interval=2")
NOISY = ("training.iterations=3", "training.instance_noise=0.1", "generator.dropout=0.2")

Found = dict[str, Any]


# --- what is computed, by one process or by each of a group ---------------------------------


def own_half(batch: Tensor, group: ProcessGroup) -> Tensor:
    return batch.chunk(group.size)[group.rank]


def norm_found(group: ProcessGroup, shape: tuple[int, ...], momentum: float | None) -> Found:
    """Output, first and second derivatives and running statistics of a batch norm."""
    random = torch.Generator().manual_seed(4)
    x, weight = (torch.randn(shape, generator=random, dtype=torch.float64) for _ in range(2))
    norm = nn.BatchNorm1d(shape[1], momentum=momentum).double()
    with torch.no_grad():
        norm.weight.copy_(torch.tensor([0.5, 1.5, -2.0]))
        norm.bias.copy_(torch.tensor([0.1, 0.2, 0.3]))
    network = nn.Sequential(norm)
    share_norms(network, group)
    own, own_weight = own_half(20 + 3 * x, group).requires_grad_(), own_half(weight, group)
    for _ in range(2):
        y = network(own)
    (slope,) = torch.autograd.grad((own_weight * y.sin()).sum(), own, create_graph=True)
    (curved,) = torch.autograd.grad(slope.square().sum(), own, retain_graph=True)
    slope.square().mean().backward()
    group.average_gradients(network.parameters())
    return {
        "of pulses": {"y": y.detach(), "slope": slope.detach(), "curved": curved},
        "same": {"weight": norm.weight.grad, "bias": norm.bias.grad} | network.state_dict(),
    }


def quiet(model: CycleGan) -> None:
    """Make outputs depend on the input alone, and rounding small."""
    model.double()
    for network in (model.ren, model.iren):
        nn.init.zeros_(network.latent_log_variance.weight)
        nn.init.constant_(network.latent_log_variance.bias, -200.0)


def steps_found(group: ProcessGroup, overrides: list[str], sets) -> Found:
    """Losses and gradients of the first step, and the weights after a few."""
    recipe = load_recipe("paper", overrides)
    torch.manual_seed(2)
    model = CycleGan(recipe).train()
    quiet(model)
    share_norms(model, group)
    step = Step(model, recipe.cyclegan.training, fast=False, group=group)
    found: Found = {}
    for number in range(STEPS):
        batches = [
            own_half(torch.from_numpy(np.roll(s, number, 0)[:8])[:, None].double(), group)
            for s in sets
        ]
        losses = step(number, *batches)
        if not number:
            gradients = {name: p.grad.clone() for name, p in model.named_parameters()}
            found |= {"losses": losses, "gradients": gradients}
    return found | {"weights": copy.deepcopy(model.state_dict())}


def training_found(group: ProcessGroup, overrides: list[str], sets) -> Found:
    """A training from its start to its end, in float64: records and weights."""
    recipe = load_recipe("paper", overrides)
    records: list[Any] = []

    doubled = [pulses.astype(np.float64) for pulses in sets]
    model = train(*doubled, recipe, seed=3, init=quiet, listener=records.extend, group=group)
    losses = [[r["losses"][n] for n in LOSS_NAMES[:6]] for r in records]
    return {"weights": model.state_dict(), "losses": torch.tensor(losses, dtype=torch.float64)}


def resumed_found(group: ProcessGroup, overrides: list[str], sets) -> Found:
    """Weights of a noisy training in one go, and of one that process 1 has stopped."""
    recipe = load_recipe("paper", overrides)
    whole = train(*sets, recipe, seed=5, group=group).state_dict()
    states: list[Any] = []
    asked: list[int] = []

    def stop() -> bool:
        asked.append(0)
        return group.rank == group.size - 1 and len(asked) == 1

    hooks = CheckpointHooks(lambda state: states.append(copy.deepcopy(state)), stop=stop)
    with pytest.raises(StoppedError, match=r"^stopped after 1 of 3 iterations"):
        train(*sets, recipe, seed=5, hooks=hooks, group=group)
    kept = len(states)
    start = share_state(group, states[-1] if states else None)
    hooks = CheckpointHooks(lambda _state: None, start)
    again = train(*sets, recipe, seed=5, hooks=hooks, group=group).state_dict()
    return {"whole": whole, "again": again, "kept": kept, "random": start["random"]}


# --- a process of a group --------------------------------------------------------------------


def message(act: Callable[[], Any]) -> str:
    with pytest.raises(CpunetError) as error:
        act()
    return str(error.value)


def work(folder: Path, job: dict[str, Any]) -> None:
    """All that a process of the group does."""
    torch.set_num_threads(1)
    sets = [np.load(folder / f"{side}.npy") for side in ("sim", "data")]
    found: Found = {}
    launched = launch()
    assert launched is not None
    rank = launched.group.rank
    try:
        with meeting(launched) as join:
            group = join("cpu")
            found["any"] = [group.any(False), group.any(group.rank == 1), group.any(True)]
            found["told"] = [len(group.told(b"")), group.told(b"of 0" * (1 - group.rank))]
            for name, arguments in job["norms"].items():
                found[name] = norm_found(group, *arguments)
            for name, overrides in job["steps"].items():
                found[name] = steps_found(group, overrides, sets)
            found["training"] = training_found(group, job["training"], sets)
            found["resumed"] = resumed_found(group, job["resumed"], sets)
            found["others"] = message(
                lambda: require_same_everywhere(group, {"seed": group.rank})
            )
            require_same_everywhere(group, {"seed": 1})
            sets[1][5] = np.nan  # of a pulse that one process is dealt
            training_found(group, job["training"], sets)
    except CpunetError as error:
        found["diverged"] = [type(error).__name__, str(error)]
    torch.save(found, folder / f"found-{rank}.pt")

    os.environ["MASTER_PORT"] = str(job["port"])
    lost: list[Any] = []
    try:
        with meeting(launched) as join:
            group = join("cpu")
            group.any(False)
            if rank == 1:
                os._exit(9)
            group.any(False)
    except CpunetError as error:
        lost = [type(error).__name__, str(error)]
    (folder / f"lost-{rank}.json").write_text(json.dumps(lost))


def work_on_gpus(folder: Path, job: dict[str, Any]) -> None:
    """A training on a GPU per process."""
    sets = [np.load(folder / f"{side}.npy") for side in ("sim", "data")]
    launched = launch()
    assert launched is not None
    device = f"cuda:{launched.local_rank}"
    recipe = load_recipe("paper", job["recipe"])
    with torch.cuda.device(device), meeting(launched) as join:
        group = join(device)
        model = train(*sets, recipe, seed=3, device=device, group=group)
    torch.save(model.cpu().state_dict(), folder / f"found-{launched.group.rank}.pt")


# --- the tests ------------------------------------------------------------------------------


def free_ports(n: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(n)]
    ports = [s.getsockname()[1] for s in sockets]
    for s in sockets:
        s.close()
    return ports


@pytest.fixture(scope="module")
def job() -> dict[str, Any]:
    from_conftest = runpy.run_path(str(Path(__file__).with_name("conftest.py")))
    tiny = [*from_conftest["TINY"], *QUIET]
    return {
        "norms": {"pulses": ((6, 3, 5), 0.1), "vectors": ((6, 3), None)},
        "steps": {
            f"penalty {p}": [*tiny, *CLIPPED, f"training.losses.gradient_penalty={p}"]
            for p in PENALTIES
        },
        "training": [*tiny, "training.average_decay=0.5", "generator.residual=true", *SHORT],
        "resumed": [*tiny, *NOISY],
    }


@pytest.fixture(scope="module")
def sides() -> tuple[np.ndarray, np.ndarray]:
    return small_sides()


def run_pair(
    held: ModuleType, folder: Path, sides, job: dict[str, Any], doing: Callable[..., None]
) -> list[int]:
    """Let two processes do their work; their statuses."""
    for side, pulses in zip(("sim", "data"), sides, strict=True):
        np.save(folder / f"{side}.npy", pulses)
    first, second = map(str, free_ports(2))
    told = {"WORLD_SIZE": str(SIZE), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": first}
    processes = []
    for rank in range(SIZE):
        given = {
            "ENVIRONMENT": told | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            "CALL": (doing.__name__, folder, job | {"port": second}),
        }
        processes.append(held.forked(__file__, given, PROCESS))
    for process in processes:
        process.join()
    return [process.exitcode for process in processes]


@pytest.fixture(scope="module")
def folder(job, sides, held, tmp_path_factory) -> Path:
    """What the two processes found."""
    folder = tmp_path_factory.mktemp("group")
    assert run_pair(held, folder, sides, job, work) == [0, 9]
    return folder


@pytest.fixture(scope="module")
def found(folder) -> list[Found]:
    return [torch.load(folder / f"found-{rank}.pt") for rank in range(SIZE)]


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["pulses", "vectors"])
def test_a_norm_of_a_group_is_that_of_all_its_pulses(job, found, name):
    alone = norm_found(ALONE, *job["norms"][name])
    for part, expected in alone["of pulses"].items():
        whole = torch.cat([one[name]["of pulses"][part] for one in found])
        torch.testing.assert_close(whole, expected, rtol=1e-9, atol=1e-9)
    for one in found:
        assert one[name]["same"].keys() == alone["same"].keys()
        for part, expected in alone["same"].items():
            torch.testing.assert_close(one[name]["same"][part], expected, rtol=1e-9, atol=1e-9)


def test_a_norm_of_a_group_has_the_same_names_and_evaluates_the_same():
    plain = nn.Sequential(nn.Conv1d(1, 3, 3), nn.BatchNorm1d(3))
    plain(torch.randn(5, 1, 9))
    shared = copy.deepcopy(plain)
    share_norms(shared, ProcessGroup(0, 2))
    assert isinstance(shared[1], GroupBatchNorm)
    assert isinstance(copy.deepcopy(shared)[1], GroupBatchNorm)  # as for running averages
    assert [n for n, _ in shared.named_parameters()] == [n for n, _ in plain.named_parameters()]
    x = torch.randn(4, 1, 9)
    assert torch.equal(shared.eval()(x), plain.eval()(x))
    other = nn.Sequential(nn.Conv1d(1, 3, 3), nn.BatchNorm1d(3))
    other.load_state_dict(shared.state_dict())
    shared.load_state_dict(plain.state_dict())
    assert same(other.state_dict(), plain.state_dict())


def test_alone_all_norms_stay_as_they_are():
    network = nn.Sequential(nn.BatchNorm1d(3))
    share_norms(network, ALONE)
    assert type(network[0]) is nn.BatchNorm1d


@pytest.mark.thorough
@pytest.mark.parametrize("penalty", PENALTIES)
def test_steps_are_those_of_one_process(job, found, sides, penalty):
    name = f"penalty {penalty}"
    alone = steps_found(ALONE, job["steps"][name], sides)
    for one in found:
        assert one[name]["losses"].keys() == alone["losses"].keys() == set(LOSS_NAMES)
        for part in ("losses", "gradients"):
            for key, expected in alone[part].items():
                torch.testing.assert_close(
                    one[name][part][key], expected, rtol=1e-9, atol=1e-12
                )
        for key, expected in alone["weights"].items():
            torch.testing.assert_close(
                one[name]["weights"][key], expected, rtol=1e-6, atol=1e-7
            )
    assert same(found[0][name]["weights"], found[1][name]["weights"])


@pytest.mark.thorough
def test_a_training_is_that_of_one_process(job, found, sides):
    alone = training_found(ALONE, job["training"], sides)
    first, second = (one["training"] for one in found)
    assert same(first["weights"], second["weights"])
    assert len(second["losses"]) == 0  # one process alone tells
    torch.testing.assert_close(first["losses"], alone["losses"], rtol=1e-6, atol=1e-7)
    for key, expected in alone["weights"].items():
        torch.testing.assert_close(first["weights"][key], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.thorough
def test_a_resumed_group_ends_with_the_same_bits(found):
    first, second = (one["resumed"] for one in found)
    assert (first["kept"], second["kept"]) == (1, 0)
    for one in (first, second):
        assert same(one["whole"], one["again"])
    assert same(first["whole"], second["whole"])
    noises = [random["cpu"] for random in second["random"]]
    assert len(noises) == SIZE
    assert not torch.equal(*noises)


@pytest.mark.thorough
def test_a_state_goes_on_in_a_group_of_another_size(found, job, sides):
    recipe = load_recipe("paper", job["resumed"])
    states: list[Any] = []
    hooks = CheckpointHooks(
        lambda state: states.append(copy.deepcopy(state)), stop=lambda: True
    )
    with pytest.raises(StoppedError):
        train(*sides, recipe, seed=5, hooks=hooks)
    (state,) = states
    assert len(state["random"]) == 1
    of_two = found[0]["resumed"]["random"]
    hooks = CheckpointHooks(lambda _state: None, state | {"random": of_two})
    model = train(*sides, recipe, seed=5, hooks=hooks)
    assert all(bool(torch.isfinite(value).all()) for value in model.state_dict().values())


@pytest.mark.thorough
def test_what_is_told_and_asked(found):
    for one in found:
        assert one["any"] == [False, True, True]
        assert one["told"] == [0, b"of 0"]


@pytest.mark.thorough
def test_other_settings_in_one_process(found):
    assert [one["others"] for one in found] == 2 * [
        "process 1 has other settings or pulses than process 0; start all with the same "
        "options and files"
    ]


@pytest.mark.thorough
def test_an_error_of_all_is_told_once(found):
    kinds = {one["diverged"][0] for one in found}
    assert kinds == {CpunetError.__name__, ToldElsewhereError.__name__}
    for one in found:
        assert one["diverged"][1].startswith("training diverged: ")


@pytest.mark.thorough
def test_a_process_that_dies_ends_the_other(folder):
    kind, text = json.loads((folder / "lost-0.json").read_text())
    assert kind == CpunetError.__name__
    assert text == (
        "another process of this training ended or cannot be reached; continue with --resume"
    )


def test_the_shares_of_a_deck_are_the_batch():
    pulses = torch.arange(20.0)[:, None, None]
    whole, *shares = (
        EpochSampler(pulses, 6, 1, group)
        for group in (ALONE, *(ProcessGroup(r, 3) for r in range(3)))
    )
    for _ in range(5):
        batch = whole.next_batch()
        assert torch.equal(torch.cat([share.next_batch() for share in shares]), batch)
    with pytest.raises(
        CpunetError, match=r"batch_size=6 cannot be shared equally by 4 proc.*multiple of 4"
    ):
        EpochSampler(pulses, 6, 1, ProcessGroup(0, 4))


@pytest.mark.parametrize("missing", ["MASTER_ADDR", "MASTER_PORT", "LOCAL_RANK"])
def test_half_a_launch(monkeypatch, missing):
    told = {"RANK": "1", "LOCAL_RANK": "0", "WORLD_SIZE": "3", "MASTER_PORT": "1"}
    for name, value in (told | {"MASTER_ADDR": "127.0.0.1"}).items():
        monkeypatch.setenv(name, value)
    launched = launch()
    assert launched is not None
    assert (launched.group, launched.local_rank) == (ProcessGroup(1, 3), 0)
    monkeypatch.delenv(missing)
    with pytest.raises(CpunetError, match=f"but not {missing}; start with torchrun"):
        launch()
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert launch() is None


@pytest.mark.gpu
@pytest.mark.skipif(torch.cuda.device_count() < SIZE, reason="fewer than two CUDA devices")
@pytest.mark.parametrize("penalty", PENALTIES)
def test_a_training_on_two_gpus(job, sides, held, tmp_path, penalty):
    recipe = [*job["training"], f"training.losses.gradient_penalty={penalty}"]
    assert run_pair(held, tmp_path, sides, {"recipe": recipe}, work_on_gpus) == [0, 0]
    first, second = (torch.load(tmp_path / f"found-{rank}.pt") for rank in range(SIZE))
    assert same(first, second)
    assert all(bool(torch.isfinite(value).all()) for value in first.values())


if __name__ == PROCESS:
    given = globals()
    os.environ.update(given["ENVIRONMENT"])
    name, *arguments = given["CALL"]
    given[name](*arguments)
