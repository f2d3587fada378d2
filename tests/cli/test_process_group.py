"""``cpunet train`` as torchrun starts it: one run folder, one line per error."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from cpunet.cli.main import main
from cpunet.training.unfinished import UnfinishedRun
from synthetic import digests

PROCESS = "one of a group"  # the name of this module in a process of a group
SETTINGS = [
    "training.checkpoint_interval=1",
    "training.log_interval=1",
    "training.losses.gradient_penalty=0",
    "training.iterations=3",
]


def start(
    held: ModuleType, folder: Path, rank: int, environment: dict[str, str], words: list[str]
) -> Any:
    """Start the command as a process of a group."""
    own = {"RANK": str(rank), "LOCAL_RANK": str(rank), "OMP_NUM_THREADS": "1"}
    given = {"ENVIRONMENT": environment | own, "WORDS": words, "FOLDER": str(folder)}
    return held.forked(__file__, given, PROCESS)


Pair = Callable[..., Any]


@pytest.fixture
def pair(held) -> Pair:
    return partial(run_pair, held)


def run_pair(
    held: ModuleType, folder: Path, *words: object, environment: dict[str, str] | None = None
) -> Any:
    """Run the command in two processes; their statuses and all that they printed."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    told = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2"}
    told |= environment or {}
    folder.mkdir(exist_ok=True)
    processes = [start(held, folder, rank, told, [*map(str, words)]) for rank in range(2)]
    for process in processes:
        process.join()
    printed = [(folder / f"err-{rank}").read_text() for rank in range(2)]
    return SimpleNamespace(
        codes=[process.exitcode for process in processes],
        out=[(folder / f"out-{rank}").read_text() for rank in range(2)],
        err=printed,
        errors=[line for text in printed for line in text.splitlines() if "error" in line],
    )


@pytest.fixture
def words(stand, tiny, tmp_path) -> list[object]:
    out = tmp_path / "out" / "run"
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    return ["train", *stand.inputs, "--out", out, *tiny, *settings, "--threads", "1"]


@pytest.mark.slow
def test_a_group_trains_and_goes_on(words, pair, tmp_path, command):
    told, run = tmp_path / "told", tmp_path / "out" / "run"
    done = pair(told, *words)
    assert (done.codes, done.errors) == ([0, 0], [])
    assert done.out[0].startswith(f"{run}: trained in ")
    assert "Training: done" in done.err[0]
    assert (done.out[1], done.err[1]) == ("", "")
    assert [path.name for path in run.parent.iterdir()] == ["run"]
    assert json.loads((run / "run.json").read_text())["processes"] == 2
    expected = digests(run)

    # refused by the one that sees the folder
    again = pair(told, *words)
    assert (again.codes, len(again.errors)) == ([2, 2], 1)
    assert again.errors[0].startswith(f"error: {run}: exists")
    shutil.rmtree(run)

    stopped = pair(told, *words, environment={"SIGNAL_AFTER": "1"})
    assert stopped.codes == 2 * [128 + signal.SIGTERM]
    assert stopped.errors == ["error: stopped after 2 of 3 iterations; continue with --resume"]
    assert [path.name for path in run.parent.iterdir()] == ["run.unfinished"]
    shutil.copytree(run.parent / "run.unfinished", run.parent / "alone.unfinished")
    resumed = pair(told, *words, "--resume")
    assert (resumed.codes, resumed.errors) == ([0, 0], [])
    assert resumed.err[0].splitlines().count("going on after 2 iterations") == 1
    assert "warning" not in resumed.err[0]
    assert digests(run) == expected

    alone = command(*words, "--out", run.parent / "alone", "--resume")
    assert alone.code == 0
    assert "warning: resumed elsewhere: processes 2 → 1; the last bits may differ" in alone.err


@pytest.mark.parametrize(
    ("more", "line"),
    [
        (
            ["--set", "training.batch_size=5"],
            "error: training.batch_size=5 cannot be shared equally by 2 processes; give a "
            "multiple of 2",
        ),
        (
            ["--recipe", "no-such-recipe"],
            "error: recipe 'no-such-recipe': neither",
        ),
        (["--device", "gpu"], "error: device 'gpu' is not known"),
    ],
)
def test_an_error_is_one_line(words, pair, tmp_path, more, line):
    refused = pair(tmp_path / "told", *words, *more)
    assert refused.codes == [2, 2]
    assert len(refused.errors) == 1
    assert refused.errors[0].startswith(line)
    assert not (tmp_path / "out" / "run").exists()


@pytest.mark.parametrize(
    ("recipe", "told"),
    [
        ("fast", "takes a minute in one process;"),
        ("small", "takes minutes in one process, its chain being matched first;"),
    ],
)
def test_a_matching_recipe_needs_no_group(stand, pair, tmp_path, recipe, told):
    words = ["train", *stand.inputs, "--recipe", recipe, "--out", tmp_path / "run"]
    refused = pair(tmp_path / "told", *words)
    assert refused.codes == [2, 2]
    assert refused.errors == [f"error: recipe {recipe}: {told} start it without torchrun"]


@pytest.mark.slow
def test_torchrun(words, held, tmp_path):
    """As above, through torchrun, which passes on a signal."""
    # a held training ends with the iteration after the one that it is held at
    words = [*words, "--set", f"training.iterations={held.AFTER + 2}"]
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command = [*launcher, "--nproc-per-node", "2", "--no-python"]
    plain = [sys.executable, "-c", "from cpunet.cli.main import main; main()"]
    run = tmp_path / "out" / "run"

    def begin(program: list[str]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [*command, *program, *map(str, words), "--resume"],
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )

    job = begin(plain)
    assert "Traceback" not in job.communicate()[1]
    assert job.returncode == 0
    expected = digests(run)
    shutil.rmtree(run)
    job = begin(held.PROGRAM)
    held.wait_until_held(lambda: job.poll() is None, run.parent / "run.unfinished")
    job.terminate()
    told = job.communicate()[1].splitlines()
    assert job.returncode != 0
    assert sum(line.startswith("error: ") for line in told) == 1
    stopped = f"error: stopped after {held.AFTER + 1} of {held.AFTER + 2} iterations"
    assert any(line.startswith(stopped) for line in told)
    job = begin(plain)
    assert "Traceback" not in job.communicate()[1]
    assert job.returncode == 0
    assert digests(run) == expected


def signalled_after(records: int) -> None:
    """Send the process that leads a signal once it has logged so often."""
    log: Callable[..., None] = UnfinishedRun.log
    calls: list[int] = []

    def watched(self: UnfinishedRun, entries: Any) -> None:
        log(self, entries)
        calls.append(0)
        if len(calls) == records:
            signal.raise_signal(signal.SIGTERM)

    UnfinishedRun.log = watched  # type: ignore[method-assign]


if __name__ == PROCESS:
    given = globals()
    os.environ.update(given["ENVIRONMENT"])
    for number, name in ((1, "out"), (2, "err")):
        target = Path(given["FOLDER"]) / f"{name}-{os.environ['RANK']}"
        os.dup2(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    if "SIGNAL_AFTER" in os.environ:
        signalled_after(int(os.environ["SIGNAL_AFTER"]))
    sys.argv = ["cpunet", *given["WORDS"]]
    main()
