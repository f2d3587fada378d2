"""An interrupted training goes on where it was, however it was interrupted."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from cpunet.jobs.inputs import InputFile
from cpunet.jobs.train import train_run
from cpunet.recipes import load_recipe
from cpunet.training.unfinished import UnfinishedRun

KEPT = ["--set", "training.checkpoint_interval=1", "--set", "training.log_interval=1"]
SEED = ("--seed", "3")  # of the fixture `trained`


def result(run: Path) -> list[str]:
    """What must not depend on how often a training was interrupted."""
    return [
        hashlib.sha256((run / name).read_bytes()).hexdigest()
        for name in ("weights.safetensors", "losses.jsonl")
    ]


def at_record(monkeypatch, number: int, act: Callable[[], None]) -> None:
    """Do something when so many bunches of records were logged."""
    log, calls = UnfinishedRun.log, []

    def watched(self, records):
        log(self, records)
        calls.append(0)
        if len(calls) == number:
            act()

    monkeypatch.setattr(UnfinishedRun, "log", watched)


@pytest.fixture
def words(stand, tiny, tmp_path) -> list[object]:
    return ["train", *stand.inputs, "--out", tmp_path / "run", *SEED, *tiny, *KEPT]


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT], ids=["TERM", "INT"])
def test_a_signal_stops_between_two_iterations(
    command, words, trained, tmp_path, monkeypatch, how
):
    with monkeypatch.context() as patched:
        at_record(patched, 2, lambda: signal.raise_signal(how))
        stopped = command(*words)
    assert stopped.code == 128 + how
    assert stopped.out == ""
    told = stopped.err.splitlines()
    assert "stopping after this iteration; once more to stop at once" in told
    assert told[-1] == "error: stopped after 3 of 4 iterations; go on with --resume"
    assert [path.name for path in tmp_path.iterdir()] == ["run.unfinished"]
    assert command(*words, "--resume").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert result(tmp_path / "run") == result(trained)
    assert [path.name for path in tmp_path.glob("run/*checkpoint*")] == []
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["resumed_at"] == [3]
    assert info["peak_memory_mb"]["host"] > 50


def test_a_second_signal_stops_at_once(command, words, trained, tmp_path, monkeypatch):
    def twice() -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patched:
        at_record(patched, 2, twice)
        stopped = command(*words)
    assert stopped.code == 128 + signal.SIGTERM
    assert stopped.err.splitlines()[-1].startswith("error: interrupted")
    assert command(*words, "--resume").code == 0  # from the checkpoint before
    assert result(tmp_path / "run") == result(trained)


def test_what_can_be_done_with_an_unfinished_training(
    command, words, stand, trained, tmp_path, monkeypatch
):
    with monkeypatch.context() as patched:
        at_record(patched, 2, lambda: signal.raise_signal(signal.SIGINT))
        command(*words)
    folder = tmp_path / "run.unfinished"
    told = json.loads((folder / "unfinished.json").read_text())
    assert (told["seed"], told["recipe"]["name"]) == (3, "small")

    def refused(*more: object) -> str:
        outcome = command(*words, *more)
        assert outcome.code == 2
        return outcome.err.splitlines()[-1]

    assert refused() == (
        f"error: {folder}: an unfinished training; go on with --resume, or begin again with "
        "--force"
    )
    assert refused("--resume", "--set", "training.batch_size=5") == (
        "error: resumed with another recipe: training.batch_size 4 → 5; give what the training "
        "was begun with, or begin again with --force"
    )
    assert "another seed: 3 → 4;" in refused("--resume", "--seed", 4)
    assert "another peak: FEP → 2600-;" in refused("--resume", "--peak", "2600-")
    waveforms, kev = stand.data_waveforms[::-1], stand.data_kev[::-1]
    other = stand.write(tmp_path / "other.lh5", "geds/raw", waveforms, kev)
    assert "resumed with another data: sha256 " in refused("--resume", "--data", other)
    fast = command(*words[:7], "--resume")
    assert fast.code == 2
    assert "recipe fast: takes a minute and keeps no checkpoints; give the" in fast.err
    # what changes no weight may be changed
    moved = shutil.copy(stand.data, tmp_path / "moved.lh5")
    same = ("--data", moved, "--set", "training.checkpoint_interval=3")
    assert command(*words, "--resume", *same).code == 0
    assert result(tmp_path / "run") == result(trained)


def test_force_begins_again(command, words, trained, tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        at_record(patched, 2, lambda: signal.raise_signal(signal.SIGINT))
        command(*words, "--seed", 8)
    # input that cannot be used costs nothing of it
    assert command(*words, "--force", "--data-table", "none").code == 2
    assert (tmp_path / "run.unfinished" / "checkpoint.safetensors").is_file()
    assert command(*words, "--force").code == 0
    assert result(tmp_path / "run") == result(trained)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (
            torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB\nGPU 0"),
            "error: the GPU's memory does not suffice; try --set training.batch_size=2",
        ),
        (
            RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"),
            "error: the computer's memory does not suffice; try --set training.batch_size=2",
        ),
    ],
)
def test_too_little_memory(command, words, tmp_path, monkeypatch, error, line):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("cpunet.jobs.train.train", fail)
    outcome = command(*words)
    assert outcome.code == 2
    assert outcome.err.splitlines()[-1] == line
    assert list(tmp_path.iterdir()) == []


def size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def trains(log: Path, done: int, alive: Callable[[], bool]) -> bool:
    """Wait until a training adds to its log; whether it does before it ends."""
    deadline = time.monotonic() + 120
    while alive() and time.monotonic() < deadline:
        if size(log) > done:
            return True
        time.sleep(0.01)
    return False


def test_killed_at_any_moment(stand, tiny, tmp_path, monkeypatch):
    """Killed by force thrice and resumed: the weights of a training in one go."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    overrides = [*tiny[3::2], "training.iterations=6", *KEPT[1::2]]
    recipe = load_recipe("small", overrides)
    files = InputFile(stand.sim), InputFile(stand.data)
    train_run(*files, tmp_path / "whole", recipe, seed=5, device="cpu")
    # forked from a server that has everything imported
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["cpunet.cli.main", "cpunet.jobs.train"])
    rng = random.Random(11)
    run, log = tmp_path / "run", tmp_path / "run.unfinished" / "losses.jsonl"
    arguments = (*files, run, recipe)
    options = {"seed": 5, "device": "cpu", "resume": True}
    for kill in range(4):
        job = context.Process(target=train_run, args=arguments, kwargs=options)
        done = size(log)
        job.start()
        if kill < 3 and trains(log, done, job.is_alive):
            time.sleep(rng.uniform(0, 0.5))
            job.kill()
        job.join(120)
        assert job.exitcode == (-signal.SIGKILL if kill < 3 else 0)
    assert result(run) == result(tmp_path / "whole")
    # one killed before its first checkpoint began again
    assert json.loads((run / "run.json").read_text())["resumed_at"]
    assert not log.parent.exists()


@pytest.mark.slow
def test_ten_kills_of_the_command(stand, tiny, tmp_path):
    """As above, through the program as it is started."""
    length = ["--set", "training.iterations=60", *KEPT]
    words = [*stand.inputs, *tiny, *length, "--threads", "1", "--resume"]
    program = "from cpunet.cli.main import main; main()"

    def start(out: Path) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-c", program, "train", *map(str, words), "--out", str(out)],
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )

    assert start(tmp_path / "whole").wait(600) == 0
    rng = random.Random(12)
    run, log = tmp_path / "run", tmp_path / "run.unfinished" / "losses.jsonl"
    for _ in range(10):
        done = size(log)
        job = start(run)
        assert trains(log, done, lambda job=job: job.poll() is None)
        time.sleep(rng.uniform(0, 0.4))
        job.kill()
        assert job.wait() == -signal.SIGKILL
    assert start(run).wait(600) == 0
    assert result(run) == result(tmp_path / "whole")
