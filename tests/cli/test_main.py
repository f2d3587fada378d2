"""The command line itself: help, and what it loads."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("words", [(), ("library",), ("import",)])
def test_no_command_at_all(command, words):
    outcome = command(*words)
    assert outcome.code == 2
    assert "Usage" in outcome.out + outcome.err


@pytest.mark.parametrize("name", [[], ["train"], ["translate"], ["validate"], ["info"]])
def test_help(command, name):
    outcome = command(*name, "--help")
    assert outcome.code == 0
    assert "Usage" in outcome.out
    expected = {"train", "translate", "validate", "info"} if not name else {"--help"}
    assert all(word in outcome.out for word in expected)


def test_the_help_does_not_load_torch():
    program = (
        "import sys; import cpunet.cli.main; "
        "heavy = {'torch', 'lh5', 'lgdo', 'dspeed', 'matplotlib', 'scipy'}; "
        "sys.exit(', '.join(sorted(heavy & sys.modules.keys())) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.thorough
def test_the_installed_command(stand):
    executable = Path(sys.executable).parent / "cpunet"
    if not executable.is_file():
        pytest.skip("cpunet is not installed beside this Python")

    def run(program: list[object], *words: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*map(str, [*program, *words])], capture_output=True, text=True, check=False
        )

    assert "Usage" in run([sys.executable, "-m", "cpunet"], "--help").stdout
    assert run([executable], "info", stand.sim).returncode == 0
