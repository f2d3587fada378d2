"""An interrupted training goes on where it was, however it was interrupted."""

from __future__ import annotations

import json
import multiprocessing
import os
import runpy
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.training.train import train
from cpunet.training.unfinished import CHECKPOINT, UnfinishedRun
from synthetic import digests

KEPT = ["--set", "training.checkpoint_interval=1", "--set", "training.log_interval=1"]
SEED = ("--seed", "3")  # of the fixture `trained`


def at_state(monkeypatch, number: int, act: Callable[[], None]) -> None:
    """Do something when so many states were stored."""
    save, calls = UnfinishedRun.save, []

    def watched(self, state):
        save(self, state)
        calls.append(0)
        if len(calls) == number:
            act()

    monkeypatch.setattr(UnfinishedRun, "save", watched)


@pytest.fixture
def words(stand, tiny, tmp_path) -> list[object]:
    return ["train", *stand.inputs, "--out", tmp_path / "run", *SEED, *tiny, *KEPT]


@pytest.mark.parametrize(
    "how",
    [
        pytest.param(signal.SIGTERM, id="TERM"),
        pytest.param(signal.SIGINT, id="INT", marks=pytest.mark.thorough),
    ],
)
def test_a_signal_stops_between_two_iterations(
    command, words, trained, tmp_path, monkeypatch, how
):
    before = signal.signal(how, signal.SIG_DFL)  # which a process of tests may ignore
    with monkeypatch.context() as patched:
        at_state(patched, 2, lambda: signal.raise_signal(how))
        stopped = command(*words)
    signal.signal(how, before)
    assert stopped.code == 128 + how
    assert stopped.out == ""
    told = stopped.err.splitlines()
    assert "stopping after this iteration; once more to stop at once" in told
    assert "stopped after 3 of 4 iterations; resume goes on from it" in told
    assert told[-1].startswith("error: interrupted")
    assert [path.name for path in tmp_path.iterdir()] == ["run.unfinished"]
    assert command(*words, "--resume").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert digests(tmp_path / "run") == digests(trained)
    assert [path.name for path in tmp_path.glob("run/*checkpoint*")] == []
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["resumed_at"] == [3]


# Each is where a training is killed: what has happened to an iteration, and its number.
MOMENTS = [
    ("its checkpoint is not in place", 1),
    ("its checkpoint is in place", 2),
    ("its checkpoint is not in place", 5),
    ("the run is not in place", 6),
]
PROCESS = "a training that is killed"  # the name of this module in its process


def die_at(moment: str, iteration: int) -> None:
    """Have this process killed by force at a moment of its training."""
    save, replace, saved = UnfinishedRun.save, Path.replace, [0]

    def die_if_now(name: str) -> None:
        if (moment, iteration) == (name, saved[-1]):
            os.kill(os.getpid(), signal.SIGKILL)

    def watched_replace(self, target):
        if Path(target).name == CHECKPOINT:
            die_if_now("its checkpoint is not in place")
        elif Path(target).name == "run":
            die_if_now("the run is not in place")
        return replace(self, target)

    def watched_save(self, state):
        saved.append(state["iteration"])
        save(self, state)
        die_if_now("its checkpoint is in place")

    UnfinishedRun.save, Path.replace = watched_save, watched_replace


def forked(given: dict[str, Any]) -> Any:
    """Run this file in a process that is forked from one in which all is imported."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["cpunet.cli", "cpunet.training.train", "cpunet.pulses.reading.hdf5", "pytest"]
    )
    process = context.Process(target=runpy.run_path, args=(__file__, given, PROCESS))
    process.start()
    return process


@pytest.mark.thorough
def test_killed_at_any_moment(stand, tiny, tmp_path):
    """Killed by force again and again and resumed: the weights of a training in one go."""
    overrides = [*tiny[3::2], "training.iterations=6", *KEPT[1::2]]
    recipe = load_recipe("published", overrides)
    files = PulseFile(stand.sim), PulseFile(stand.data)
    train(*files, tmp_path / "whole", recipe=recipe, seed=5, device="cpu")
    for moment in MOMENTS:
        given = {"MOMENT": moment, "ARGUMENTS": (*files, tmp_path / "run", recipe)}
        job = forked(given)
        job.join()
        assert job.exitcode == -signal.SIGKILL, moment
    train(*files, tmp_path / "run", recipe=recipe, seed=5, device="cpu", resume=True)
    assert digests(tmp_path / "run") == digests(tmp_path / "whole")
    # one killed before its first checkpoint began again
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["resumed_at"] == [2, 4, 6]
    assert not (tmp_path / "run.unfinished").exists()


if __name__ == PROCESS:
    asked = globals()
    torch.set_num_threads(1)
    die_at(*asked["MOMENT"])
    *given, recipe = asked["ARGUMENTS"]
    train(*given, recipe=recipe, seed=5, device="cpu", resume=True)
