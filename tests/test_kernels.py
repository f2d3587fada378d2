"""Code of compiled loops: kept, made again when what it uses changes, never mixed up."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cpunet.kernels import KernelFiles, kernel

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
