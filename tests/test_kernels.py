"""Compiled loops: kept, made again when one changes; matrix products take one thread."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import threadpool_info

from cpunet import kernels
from cpunet.processes import one_thread_for_matrices

CALLED = """
from cpunet.numbers import N
@kernel
def called(x):
    return x + N
"""
CALLING = """
from cpunet.called import called
@kernel
def calling(x):
    return 10 * called(x)
"""
LOOP = """
from numba import prange
@kernel(parallel=True)
def loop(x):
    for i in prange(2):
        x += i
    return x
"""
SHOW = "from cpunet.calling import calling as f; print(f({}), sum(f.stats.cache_hits.values()))"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A package of that name with few loops."""
    home = tmp_path / "site" / "cpunet"
    home.mkdir(parents=True)
    (home / "__init__.py").touch()
    for name in ("kernels.py", "errors.py"):
        shutil.copy(Path(kernels.__file__).with_name(name), home)
    (home / "numbers.py").write_text("N = 1")
    for name, text in {"called": CALLED, "calling": CALLING, "loop": LOOP}.items():
        (home / f"{name}.py").write_text(f"from cpunet.kernels import kernel\n{text}\n")
    return home


def begin(home: Path, program: str, **variables: str) -> subprocess.Popen[str]:
    given = {"PYTHONPATH": str(home.parent), "NUMBA_CACHE_DIR": str(home.parents[1] / "code")}
    words, environment = [sys.executable, "-c", program], os.environ | given | variables
    return subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True)


def words(process: subprocess.Popen[str]) -> list[str]:
    told, _ = process.communicate()
    assert process.returncode == 0
    return told.split()


@pytest.mark.thorough
def test_a_changed_callee_or_constant_gives_a_new_folder_and_result(home: Path) -> None:
    assert words(begin(home, SHOW.format(1))) == ["20", "0"]
    assert words(begin(home, SHOW.format(1))) == ["20", "1"]
    (home / "numbers.py").write_text("N = 2")
    assert words(begin(home, SHOW.format(1))) == ["30", "0"]
    (home / "called.py").write_text((home / "called.py").read_text().replace("+", "-"))
    assert words(begin(home, SHOW.format(1))) == ["-10", "0"]
    assert len(list((home.parents[1] / "code").iterdir())) == 3


def test_of_two_who_compile_at_once_none_has_the_code_of_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second has looked before the first has written, and writes over its index."""

    def twice(value):
        return 2 * value

    monkeypatch.setattr(kernels, "code_folder", lambda: tmp_path)
    one, other, later = (kernels.kernel(twice) for _ in range(3))
    monkeypatch.setattr(other._cache._cache_file, "_load_index", dict)
    assert (one(1), other(1.5)) == (2, 3.0)
    assert (later(1), later(1.5)) == (2, 3.0)
    assert sum(later.stats.cache_hits.values()) == 1


@pytest.mark.thorough
@pytest.mark.parametrize("first", ["import torch; torch.get_num_threads()", ""])
def test_a_parallel_loop_leaves_torch_its_threads(home: Path, first: str) -> None:
    program = (
        f"{first}\nimport numba\nfrom cpunet.loop import loop\nloop(3)\nimport torch\n"
        "print(numba.get_num_threads(), torch.get_num_threads())"
    )
    begun = begin(home, program, OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="4")
    assert words(begun) == ["4", "1"]


def threads() -> list[int]:
    """Threads of each OpenBLAS that is loaded."""
    return [
        pool["num_threads"] for pool in threadpool_info() if pool["internal_api"] == "openblas"
    ]


def test_one_thread_within_and_all_after_though_it_fails() -> None:
    scipy.linalg.eigh(np.eye(2))  # both are loaded
    before = threads()
    within: list[int] = []

    @one_thread_for_matrices()
    def fails() -> None:
        within.extend(threads())
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fails()
    assert set(within) <= {1}
    assert threads() == before
