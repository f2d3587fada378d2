"""A job that is stopped or killed leaves nothing half-written, and goes on."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    "how",
    [
        pytest.param(signal.SIGTERM, id="TERM"),
        # tests/cli/test_resume.py kills by force at each moment that there is
        pytest.param(signal.SIGKILL, id="KILL", marks=pytest.mark.slow),
    ],
)
def test_a_training_that_was_ended_goes_on(
    stand, tiny, trained, held, command, tmp_path: Path, how
):
    settings = [word for setting in held.SETTINGS for word in ("--set", setting)]
    words = ["train", *stand.inputs, "--out", tmp_path / "run", "--seed", "3", *tiny, *settings]
    unfinished, errors = tmp_path / "run.unfinished", tmp_path / "errors"
    given = {"words": [*map(str, words)], "errors": str(errors)}
    job = held.forked(held.__file__, {"GIVEN": given})
    held.wait_until_held(job.is_alive, unfinished)
    os.kill(job.pid, how)
    job.join()
    told = errors.read_text()
    errors.unlink()
    if how == signal.SIGTERM:
        assert job.exitcode == 128 + how
        assert "stopped after 2 of 4 iterations; resume goes on" in told
    else:
        assert job.exitcode == -how
    assert "Traceback" not in told
    assert [path.name for path in tmp_path.iterdir()] == [unfinished.name]
    assert (unfinished / "checkpoint.pt").is_file()
    assert command(*words, "--resume").code == 0
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["resumed_at"] == [2 if how == signal.SIGTERM else held.AFTER]
    for name in ("weights.safetensors", "losses.jsonl"):
        assert (tmp_path / "run" / name).read_bytes() == (trained / name).read_bytes()
