"""Environments of containers, batch systems and scripts; no torch; interruptions."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest

import cpunet
from cpunet.kernels import kernel
from cpunet.training.unfinished import UnfinishedRun
from synthetic import digests, in_a_process, write_chain

NO_TORCH = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
"""
KEPT = ["--set", "training.checkpoint_interval=1", "--set", "training.log_interval=1"]
SEED = ("--seed", "3")  # of the fixture `trained`


def python(*words: object, status: int = 0, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, check=False,
        env=os.environ | environment,
    )  # fmt: skip
    said = (done.stdout + done.stderr).decode("utf-8", "surrogateescape")
    assert done.returncode == status, said
    return said


def test_without_docstrings(stand):
    done = in_a_process("--help", "info --help", f"info {stand.sim}", PYTHONOPTIMIZE="2")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_characters_that_a_terminal_lacks_are_replaced(stand, encoding):
    name = stand.folder / "caf\udce9.lh5"
    if not name.exists():
        os.link(stand.sim, name)
    commands = f"info {name}", f"info {name}/\u03bc"
    done = in_a_process(*commands, PYTHONIOENCODING=encoding)
    assert f"{len(stand.sim_kev)} of 225 samples" in done.stdout
    assert (done.returncode, done.stderr.count("error: ")) == (2, 1)


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


def test_a_readout_is_used_without_torch_and_what_networks_need_is_named(tmp_path: Path, stand):
    run, outs = write_chain(tmp_path / "run", noise_kev=2), [tmp_path / n for n in "abc"]
    done = in_a_process(
        f"translate {run} {stand.sim} --seed 1 --out {outs[0]}",
        f"response {run} --out {outs[1]}",
        f"export onnx {run} {outs[2]}",
        f"train {' '.join(stand.inputs)} --recipe paper --out {tmp_path / 'd'}",
        before=NO_TORCH,
    )
    said = "error: networks need torch, which is not installed; pip install 'cpunet-hpge["
    assert done.stderr.splitlines()[-1] == f"{said}networks]'"
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["a", "b", "c", "c.noise.npz", "run"]


@pytest.mark.thorough
def test_a_quick_demo_needs_no_torch_and_says_what_it_is(tmp_path: Path):
    done = in_a_process(f"demo --quick --out {tmp_path / 'demo'}", before=NO_TORCH)
    assert done.returncode == 0, done.stderr
    report = tmp_path / "demo" / "report"
    drawn = {path.stem for path in report.glob("*.svg")}
    assert drawn == {"SEP_mean_pulse", "SEP_current_amplitude", "SEP_single_pulse"}
    page = (report / "report.html").read_text()
    assert "This is a quick look" in page
    assert all(peak in page for peak in ("FEP", "SEP", "DEP"))


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
