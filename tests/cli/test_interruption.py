"""A job that is stopped leaves nothing half-written."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("how", "code"), [(signal.SIGTERM, 128 + signal.SIGTERM), (signal.SIGINT, 130)]
)
def test_a_stopped_training_leaves_what_it_can_go_on_from(
    stand, tiny, tmp_path: Path, how, code
):
    endless = ["--set", "training.iterations=100000", "--set", "training.log_interval=1"]
    words = ["train", *stand.inputs, "--out", tmp_path / "run", *tiny, *endless]
    program = "import sys; from cpunet.cli.main import main; sys.exit(main())"
    job = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, words)], stderr=subprocess.PIPE, text=True
    )
    log = tmp_path / "run.unfinished" / "losses.jsonl"
    try:
        deadline = time.monotonic() + 120
        while not (log.exists() and log.stat().st_size) and job.poll() is None:
            assert time.monotonic() < deadline, "the training did not start"
            time.sleep(0.1)
        job.send_signal(how)
        told = job.communicate(timeout=60)[1]
    finally:
        job.kill()
    assert job.returncode == code
    assert told.splitlines()[-1].startswith("error: stopped after ")
    assert "Traceback" not in told
    assert [path.name for path in tmp_path.iterdir()] == [log.parent.name]
    assert (log.parent / "checkpoint.safetensors").is_file()
