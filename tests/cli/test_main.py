"""The command line itself: help, and what it loads."""

from __future__ import annotations

import subprocess
import sys

import h5py
import numpy as np
import pytest

from cpunet.cli import COMMANDS


def test_help(command):
    outcome = command("--help")
    assert outcome.code == 0
    for name in COMMANDS:
        assert f" {name.split()[0]} " in outcome.out


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_has_examples(command, name):
    outcome = command(*name.split(), "--help")
    assert outcome.code == 0
    usage, _, examples = outcome.out.partition("Examples:\n")
    assert f"Usage: cpunet {name}" in usage
    assert all(line.startswith(f"  cpunet {name} ") for line in examples.splitlines())
    assert examples


def test_words_that_are_missing_or_unknown_are_named(command):
    assert command("train", "--sim", "sim.lh5").err == (
        "error: --data is missing; see cpunet train --help\n"
    )
    assert command("trai").err.startswith('error: Unknown command "trai"')


@pytest.mark.parametrize("words", [["--help"], ["train", "--help"]])
def test_the_help_does_not_load_torch(words):
    program = (
        "import io, sys; import cpunet.cli; sys.stdout = io.StringIO(); "
        f"cpunet.cli.run({words}); "
        "heavy = {'torch', 'lh5', 'lgdo', 'dspeed', 'matplotlib', 'scipy', 'numba'}; "
        "sys.exit(', '.join(sorted(heavy & sys.modules.keys())) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["pulses.lh5", "pulses.h5", "pulses.npy", "pulses.npz"])
def test_plain_files_load_neither_torch_nor_the_lh5_library(stand, tmp_path, name):
    """A look at a file waits for nothing that networks, compressed traces or figures need."""
    file, traces = tmp_path / name, stand.data_waveforms
    if name.endswith(".lh5"):
        stand.write(file, "geds/raw", traces, stand.data_kev)
    elif name.endswith(".h5"):
        with h5py.File(file, "w") as out:
            out["waveforms"], out["energy_kev"] = traces, stand.data_kev
    elif name.endswith(".npz"):
        np.savez(file, waveforms=traces, energy_kev=stand.data_kev)
    else:
        np.save(file, traces)
    period = [] if name.endswith(".lh5") else ["--dt-ns", "16"]
    program = (
        "import sys, cpunet.cli as program\n"
        f"sys.argv[1:] = {['info', str(file), *period]}\n"
        "try:\n    program.main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "heavy = {'torch', 'lh5', 'lgdo', 'dspeed', 'pandas', 'matplotlib', 'hist'}\n"
        "sys.exit(', '.join(sorted(heavy & sys.modules.keys())) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert f"{len(traces)} of {traces.shape[1]} samples, every 16 ns" in done.stdout
