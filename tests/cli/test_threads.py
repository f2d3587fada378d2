"""How OpenMP's threads wait, as the library that torch brings says it."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from cpunet.cli.environment import SPIN_COUNT

# the entry point up to where it would look at its arguments; then OpenMP, as torch loads it
SCRIPT = """
import ctypes, sys
from cpunet.cli import main
main.app = lambda *_words, **_options: ctypes.CDLL(sys.argv[1]) and None
assert "torch" not in sys.modules
main.main()
"""


def libgomp() -> Path:
    """Torch's own OpenMP library; torch is not imported for it."""
    spec = find_spec("torch")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent / "lib" / "libgomp.so.1"


@pytest.mark.skipif(not libgomp().exists(), reason="torch comes with another OpenMP")
@pytest.mark.parametrize(
    ("user", "spins"),
    [
        ({}, SPIN_COUNT),
        ({"GOMP_SPINCOUNT": "77"}, "77"),
        ({"OMP_WAIT_POLICY": "PASSIVE"}, "0"),
    ],
)
def test_threads_soon_sleep_unless_the_user_says_otherwise(
    user: dict[str, str], spins: str
) -> None:
    ours = {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}
    env = {name: value for name, value in os.environ.items() if name not in ours}
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(libgomp())],
        env=env | user | {"OMP_DISPLAY_ENV": "VERBOSE"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"GOMP_SPINCOUNT = '{spins}'" in run.stderr
