"""Code of compiled loops: kept, made again when what it uses changes, never mixed up."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from cpunet.kernels import KernelFiles, code_folder, kernel, sources
from cpunet.trusted_folders import trusted

CALLED = """
from cpunet.kernels import kernel

@kernel
def called(x):
    return x + {number}
"""
CALLING = """
from cpunet.kernels import kernel
from loops.called import called

@kernel
def calling(x):
    return 10 * called(x)
"""
PROGRAM = """
from loops.calling import calling
print(calling(1), sum(calling.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_other_code_of_a_called_function_is_taken(tmp_path: Path) -> None:
    package = tmp_path / "loops"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "calling.py").write_text(CALLING)
    told = []
    for number in (1, 1, 2):
        (package / "called.py").write_text(CALLED.format(number=number))
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                f"import sys; sys.path.insert(0, {str(tmp_path)!r}){PROGRAM}",
            ],
            capture_output=True,
            text=True,
            check=True,
        )
        told.append(done.stdout.strip())
    assert told == ["20 0", "20 1", "30 0"]


@pytest.mark.parametrize(
    "line",
    [
        "import loops.called",
        "from loops.called import called",
        "from loops import called as other",
        "from loops import (  # several\n    numbers,\n    called,\n)",
    ],
)
def test_code_depends_on_all_modules_that_are_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    package = tmp_path / "loops"
    package.mkdir()
    for name, text in {"__init__": "", "numbers": "", "called": "called = 1"}.items():
        (package / f"{name}.py").write_text(text)
    (package / "calling.py").write_text(line)
    monkeypatch.syspath_prepend(tmp_path)
    sources.cache_clear()
    try:
        import_module("loops.calling")
        assert package / "called.py" in sources("loops.calling")
    finally:
        sources.cache_clear()
        for name in [name for name in sys.modules if name.partition(".")[0] == "loops"]:
            del sys.modules[name]


@pytest.mark.thorough
def test_of_two_who_need_the_same_code_one_compiles(tmp_path: Path) -> None:
    package = tmp_path / "loops"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "called.py").write_text(CALLED.format(number=1))
    program = (
        f"import os, sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from loops.called import called\n"
        "child = os.fork()\n"
        "called(1)\n"
        "hits = sum(called.stats.cache_hits.values())\n"
        "if child == 0:\n"
        "    os._exit(hits)\n"
        "print(hits + os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "1"  # one of the two had it from the other
    assert not list(tmp_path.rglob("*.lock"))


def test_sums_in_an_order_of_the_compilers_choice_are_part_of_what_calls_them() -> None:
    """Else a process that compiles has other last bits than those that load its code."""

    def total(values):
        return values.sum()

    assert kernel(fastmath={"reassoc"})(total).targetoptions["forceinline"]
    assert not kernel(total).targetoptions.get("forceinline")


@pytest.fixture
def files(tmp_path: Path) -> list[KernelFiles]:
    """The same files as two processes see them."""
    return [KernelFiles(str(tmp_path), "loop", "stamp") for _ in range(2)]


def test_two_who_save_at_once_do_not_mix_their_code(
    files: list[KernelFiles], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second has looked before the first has written, and writes over its index."""
    one, other = files
    with monkeypatch.context() as patched:
        patched.setattr(other, "_load_index", dict)
        one.save("of one", "code of one")
        other.save("of the other", "code of the other")
    for reader in files:
        assert reader.load("of one") in (None, "code of one")
        assert reader.load("of the other") == "code of the other"
    one.save("of one", "code of one")
    assert one.load("of one") == "code of one"
    assert one.load("of the other") == "code of the other"


def test_code_of_older_sources_is_not_taken_and_removed(tmp_path: Path) -> None:
    before, after = (KernelFiles(str(tmp_path), "loop", stamp) for stamp in ("old", "new"))
    before.save("key", "old code")
    assert before.load("key") == "old code"
    assert after.load("key") is None
    after.save("other key", "new code")
    assert after.load("key") is None
    assert len([*tmp_path.iterdir()]) == 2  # one index, one piece of code


@pytest.mark.parametrize("part", ["index", "code"])
@pytest.mark.parametrize("damage", ["empty", "half", "flipped", "foreign"])
def test_damaged_code_is_compiled_again(tmp_path: Path, part: str, damage: str) -> None:
    files = KernelFiles(str(tmp_path), "loop", "stamp")
    files.save("key", "code")
    (path,) = tmp_path.glob("*.nbi" if part == "index" else "*.nbc")
    whole = path.read_bytes()
    flipped = whole[:-3] + bytes([whole[-3] ^ 4]) + whole[-2:]
    contents = {"empty": b"", "half": whole[: len(whole) // 2], "foreign": b"\xff" * 99}
    path.write_bytes((contents | {"flipped": flipped})[damage])
    found = files.load("key")
    assert found is None or (part, damage, found) == ("index", "flipped", "code")
    files.save("key", "new code")
    assert files.load("key") == "new code"


def test_code_is_never_kept_where_others_can_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "own"
    monkeypatch.setattr("platformdirs.user_cache_path", lambda _name: own)
    private, shared = tmp_path / "private", tmp_path / "shared"
    for folder, mode in ((private, 0o755), (shared, 0o777)):
        folder.mkdir()
        folder.chmod(mode)
    assert code_folder(private) == private
    for folder in (shared, shared / "below"):
        folder.mkdir(exist_ok=True)
        found = code_folder(folder)
        assert found is not None
        assert own in found.parents
        assert trusted(found)
    shared.chmod(0o775)  # a group is others, too
    assert code_folder(shared) != shared
    shared.chmod(0o1777)
    (shared / "mine").mkdir(mode=0o700)
    assert code_folder(shared / "mine") == shared / "mine"
    own.chmod(0o777)
    assert code_folder(shared) is None


def test_threads_can_be_lowered_and_raised_again():
    program = (
        "import numba, torch\nfrom cpunet.kernels import use_threads\n"
        "for count in (1, 3, 9):\n"
        "    use_threads(count)\n"
        "    print(numba.get_num_threads(), torch.get_num_threads())"
    )
    given = os.environ | {"NUMBA_NUM_THREADS": "4"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=given
    )
    assert done.stdout.splitlines() == ["1 1", "3 3", "4 9"]


PARALLEL = """
from numba import prange
from cpunet.kernels import kernel

@kernel(parallel=True)
def loop(x):
    for i in prange(2):
        x += i
    return x
"""


@pytest.mark.parametrize(
    "begin",
    [
        pytest.param("import torch; print(torch.get_num_threads())", id="torch-first"),
        pytest.param("print(1)", id="numba-first"),
    ],
)
def test_a_parallel_loop_leaves_torch_its_threads(tmp_path, begin):
    (tmp_path / "loop.py").write_text(PARALLEL)
    program = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{begin}\n"
        "import numba\nfrom loop import loop\nloop(3)\n"
        "import torch\nprint(numba.get_num_threads(), torch.get_num_threads())"
    )
    given = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "4"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=given
    )
    assert done.stdout.split() == ["1", "4", "1"]
