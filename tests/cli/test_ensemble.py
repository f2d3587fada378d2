"""``cpunet ensemble`` on the command line, stopped and gone on with."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROGRAM = "import sys; from cpunet.cli.main import main; sys.exit(main())"
LONG = [
    "training.iterations=30",
    "training.decay_start=15",
    "training.log_interval=1",
    "training.checkpoint_interval=1",
]


def children(pid: int) -> list[int]:
    """Processes that a process has started, and theirs."""
    try:
        own = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [p for child in map(int, own) for p in (child, *children(child))]


def is_running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=["INT", "KILL"])
def test_a_stopped_ensemble_leaves_no_process_and_goes_on(
    stand, tiny, command, tmp_path: Path, how
):
    folder = tmp_path / "ens"
    more = [word for value in LONG for word in ("--set", value)]
    n = 2 if how == signal.SIGINT else 1
    seeds = ["--seeds", n, "--jobs", 2, "--threads", 1, "--no-validate"]
    words = ["ensemble", *stand.inputs, "--out", folder, *tiny, *more, *seeds]
    job = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *map(str, words)], stderr=subprocess.PIPE, text=True
    )
    logs = [
        folder / f"seed_00{seed}.unfinished" / "checkpoint.safetensors" for seed in range(n)
    ]
    try:
        deadline = time.monotonic() + 120
        while not all(log.exists() for log in logs) and job.poll() is None:
            assert time.monotonic() < deadline, "the trainings did not start"
            time.sleep(0.05)
        started = children(job.pid)
        assert len(started) >= n
        job.send_signal(how)
        told = job.communicate(timeout=90)[1]
    finally:
        job.kill()
    while any(map(is_running, started)):
        assert time.monotonic() < deadline, "a process was left behind"
        time.sleep(0.1)
    assert "Traceback" not in told
    if how == signal.SIGINT:
        assert job.returncode == 130
        assert "go on with --resume" in told.splitlines()[-1]
    assert all(log.exists() for log in logs)
    if how == signal.SIGKILL:
        return
    done = command(*words, "--resume")
    assert done.code == 0
    assert "2 of 2 seeds trained" in done.out
    for seed in (0, 1):
        info = json.loads((folder / f"seed_00{seed}" / "run.json").read_text())
        assert info["seed"] == seed
        assert len(info["resumed_at"]) == 1
    assert not list(folder.glob("*.unfinished"))


def test_a_table_and_a_figure(stand, tiny, command, tmp_path):
    folder = tmp_path / "ens"
    words = [*stand.inputs, "--out", folder, "--seeds", 1, "--truth", stand.truth, *tiny]
    done = command("ensemble", *words)
    assert done.code == 0
    for part in ("IoU over seeds", "worst 5 %", "T_drift", "edge rmse", "1 of 1 seeds trained"):
        assert part in done.out
    assert str(folder / "seeds.png") in done.out
    again = command("ensemble", *words)
    assert again.code == 2
    assert "exists already; go on with --resume" in again.err
    assert os.listdir(tmp_path) == ["ens"]  # noqa: PTH208
