"""``cpunet ensemble`` on the command line, stopped and resumed."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    "how",
    [
        pytest.param(signal.SIGINT, id="INT"),
        # that nothing of the same pool is left is seen of a search, see tests/jobs/test_tune.py
        pytest.param(signal.SIGKILL, id="KILL", marks=pytest.mark.slow),
    ],
)
def test_a_stopped_ensemble_leaves_no_process_and_goes_on(
    stand, tiny, held, command, no_pool, tmp_path: Path, how
):
    folder = tmp_path / "ens"
    more = [word for value in held.SETTINGS for word in ("--set", value)]
    n = 2 if how == signal.SIGINT else 1
    seeds = ["--seeds", n, "--jobs", 2, "--threads", 1, "--no-validate"]
    words = ["ensemble", *stand.inputs, "--out", folder, *tiny, *more, *seeds]
    errors = tmp_path / "errors"
    given = {"words": [*map(str, words)], "errors": str(errors)}
    job = held.forked(held.__file__, {"GIVEN": given})
    unfinished = [folder / f"seed_00{seed}.unfinished" for seed in range(n)]
    try:
        held.wait_until_held(job.is_alive, *unfinished)
        started = held.children(job.pid)
        assert len(started) >= n
        os.kill(job.pid, how)
        job.join()
    finally:
        job.kill()
        job.join()
    held.wait_until_gone(started)
    told = errors.read_text()
    assert "Traceback" not in told
    if how == signal.SIGINT:
        assert job.exitcode == 130
        assert "continue with --resume" in told.splitlines()[-1]
    assert all((one / "checkpoint.safetensors").exists() for one in unfinished)
    if how == signal.SIGKILL:
        return
    done = command(*words, "--resume")
    assert done.code == 0
    assert "2 of 2 seeds trained" in done.out
    for seed in (0, 1):
        info = json.loads((folder / f"seed_00{seed}" / "run.json").read_text())
        assert info["seed"] == seed
        assert info["resumed_at"] == [3]
    assert not list(folder.glob("*.unfinished"))


@pytest.mark.thorough
def test_a_table_and_a_figure(stand, tiny, command, tmp_path, no_pool):
    folder = tmp_path / "ens"
    words = [*stand.inputs, "--out", folder, "--seeds", 1, "--truth", stand.truth, *tiny]
    done = command("ensemble", *words)
    assert done.code == 0
    for part in ("IoU over seeds", "worst 5 %", "T_drift", "edge rmse", "1 of 1 seeds trained"):
        assert part in done.out
    assert str(folder / "seeds.png") in done.out
    again = command("ensemble", *words)
    assert again.code == 2
    assert "exists already; continue with --resume" in again.err
    assert os.listdir(tmp_path) == ["ens"]  # noqa: PTH208
