"""The program, whose trainings wait after an iteration for a signal.

So a test can stop or kill a training that is neither too young nor done, on any machine.  A
file to be run: processes that the program starts are held in the same way.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cpunet.cli import main
from cpunet.training.checkpoints import CHECKPOINT, UnfinishedRun

AFTER = 1  # iterations
# so that a checkpoint is there to go on from
SETTINGS = ["training.checkpoint_interval=1", "training.log_interval=1"]


# what takes long to import, and a training or a test needs
PRELOADED = [
    "cpunet.cli",
    "cpunet.training.train",
    "cpunet.pulses.reading.hdf5",
    "pytest",
    "torch._dynamo",
]


def forked(file: str, given: dict[str, Any], name: str = "__main__") -> Any:
    """Start a file in a process that is forked from one in which all is imported."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    process = context.Process(target=runpy.run_path, args=(file, given, name))
    process.start()
    return process


def wait_until_held(is_running: Callable[[], bool], *unfinished: Path) -> None:
    """Wait until the trainings of these folders have stored where they wait."""
    for folder in unfinished:
        while not (folder / CHECKPOINT).exists():
            assert is_running(), "it ended before"
            time.sleep(0.02)


def children(pid: int) -> list[int]:
    """Processes that a process has started, and theirs."""
    try:
        own = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [p for child in map(int, own) for p in (child, *children(child))]


def wait_until_gone(pids: list[int]) -> None:
    """Wait for the end of processes that are not our own: for ever, if one is left behind."""
    while any(map(_is_running, pids)):
        time.sleep(0.02)


def _is_running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def hold() -> None:
    """Have trainings of this process wait."""
    heard, told = os.pipe()
    os.set_blocking(told, False)
    signal.set_wakeup_fd(told)  # written to when a signal comes, be it before the wait
    save = UnfinishedRun.save

    def held(self: UnfinishedRun, state: Any) -> None:
        save(self, state)
        if state["iteration"] == AFTER:
            os.read(heard, 1)

    UnfinishedRun.save = held  # type: ignore[method-assign]


if __name__ in ("__main__", "__mp_main__"):  # the second in processes that the first starts
    hold()
if __name__ == "__main__":
    if given := globals().get("GIVEN"):  # to a forked one
        sys.argv = ["cpunet", *given["words"]]
        os.dup2(os.open(given["errors"], os.O_WRONLY | os.O_CREAT), 2)
    sys.exit(main())
