"""Environments of containers, batch systems and scripts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import numba
import numpy as np
import pytest

import cpunet
from cpunet.kernels import kernel


def python(*words: object, status: int = 0, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, check=False,
        env=os.environ | environment,
    )  # fmt: skip
    said = (done.stdout + done.stderr).decode("utf-8", "surrogateescape")
    assert done.returncode == status, said
    return said


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_characters_that_a_terminal_lacks_are_replaced(stand, encoding):
    name = stand.folder / "caf\udce9.lh5"
    if not name.exists():
        os.link(stand.sim, name)
    said = python("-m", "cpunet", "info", name, PYTHONIOENCODING=encoding)
    assert f"{len(stand.sim_kev)} of 225 samples" in said
    python("-m", "cpunet", "info", name / "\u03bc", PYTHONIOENCODING=encoding, status=2)


def test_a_script_without_a_guard_is_named(stand, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from cpunet.processes import outcomes, usable_cores\n"
        "print([*outcomes(usable_cores, [1, 2], 2)])\n"
    )
    said = python(script, status=1).splitlines()[-1]
    assert f"{script}: processes run this script again; put its calls under if __name__" in said


def test_a_layer_of_threads_that_is_not_installed_is_replaced():
    """As clusters ask for TBB: https://github.com/numba/numba/issues/6108."""
    code = "from cpunet.kernels import start_threads as start; start(); import numba"
    code += "; print(numba.get_num_threads())"
    said = python("-c", code, NUMBA_THREADING_LAYER="tbb", NUMBA_NUM_THREADS="1")
    assert said.strip() == "1"


def loop(values):
    for i in numba.prange(len(values)):
        values[i] += 1


def test_a_parallel_loop_in_a_forked_process_names_spawn():
    parallel, values = kernel(parallel=True)(loop), np.zeros(3)
    parallel(values)
    read, write = os.pipe()
    if not (child := os.fork()):
        try:
            parallel(values)
        except cpunet.errors.CpunetError as error:
            os.write(write, str(error).encode())
        os._exit(0)
    os.close(write)
    os.waitpid(child, 0)
    assert b'get_context("spawn")' in os.read(read, 1000)
    os.close(read)


@pytest.mark.parametrize("name", ["HUP", "QUIT", "USR1", "USR2", "XCPU"])
def test_a_signal_that_is_ignored_stays_so(command, stand, monkeypatch, name):
    """As by nohup."""
    number = getattr(signal, f"SIG{name}")
    arrive = lambda *_given, **_options: signal.raise_signal(number)  # noqa: E731
    signal.signal(number, before := signal.SIG_IGN)
    try:
        with monkeypatch.context() as patched:
            patched.setattr("cpunet.inspection.pulse_file", arrive)
            command("info", stand.sim)
        assert signal.getsignal(number) == before
    finally:
        signal.signal(number, signal.SIG_DFL)
