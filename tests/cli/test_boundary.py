"""Whatever a command ends with is one line and a status."""

from __future__ import annotations

import errno
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from cpunet.calibration.identifiability import Direction
from cpunet.calibration.titles import TITLES
from cpunet.cli import messages
from cpunet.cli.environment import drop_nonsense
from cpunet.cli.streams import Notes, Results, prepare_streams

PROGRAM = "from cpunet.cli.main import main; main()"


def os_error(number: int, name: str | None = None) -> OSError:
    return OSError(number, os.strerror(number), name)


# What a job may raise: name → (exception, status, part of the line)
ENDINGS = {
    "bug": (KeyError("translated"), 70, "failed unexpectedly (KeyError: 'translated')"),
    "assertion": (AssertionError(), 70, "failed unexpectedly (AssertionError)"),
    "lines": (RuntimeError("one\n\ntwo"), 70, "(RuntimeError: one two)"),
    "memory": (MemoryError(), 2, "out of memory (no more could be had)"),
    "numpy": (MemoryError("Unable to allocate 6. GiB"), 2, "Unable to allocate 6. GiB"),
    "torch": (RuntimeError("DefaultCPUAllocator: can't allocate memory"), 2, "out of memory"),
    "cuda": (RuntimeError("CUDA out of memory. Tried"), 2, "out of memory (CUDA"),
    "full": (os_error(errno.ENOSPC, "x.lh5"), 2, "x.lh5: No space left on device; make room"),
    "denied": (os_error(errno.EACCES, "x.lh5"), 2, "x.lh5: Permission denied; ask its owner"),
    "long": (os_error(errno.ENAMETOOLONG, "x" * 4000), 2, "File name too long; choose a shor"),
    "io": (os_error(errno.EIO), 2, "Input/output error; check the disk or the network"),
    "stale": (os_error(errno.ESTALE), 2, "check the network"),
    "pipe": (BrokenPipeError(), 141, "whoever read this has stopped"),
    "name": (UnicodeEncodeError("utf-8", "\udcff.lh5", 0, 1, "surrogates"), 2, "rename"),
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_ending_is_one_line(command, monkeypatch, ending):
    error, status, part = ENDINGS[ending]

    def fail(*_words: object, **_options: object) -> None:
        raise error

    monkeypatch.setattr("cpunet.jobs.inspection.info.describe", fail)
    outcome = command("info", "x.lh5")
    assert (outcome.code, outcome.out) == (status, "")
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: ")
    assert part in line
    assert len(line) < 500
    if status == 70:
        assert "report it" in line


@pytest.mark.parametrize(
    "line", ["run[bold]", "run[/x]: 3 pulses", "hit.lh5:key: no such column", r"a\[bold]b[1]\ "]
)
def test_names_are_printed_as_they_are(capsys, line):
    """Brackets, backslashes and colons belong to a name: they are neither markup nor emoji."""
    for say in (messages.show, messages.tell):
        say(line)
        assert capsys.readouterr().out == f"{line}\n"
    for say, head in (
        (messages.fail, "error: "),
        (messages.warn, "warning: "),
        (messages.note, ""),
    ):
        say(line)
        assert capsys.readouterr().err == f"{head}{line.strip()}\n"


def test_debug_shows_where_wherever_it_stands(command, monkeypatch):
    def fail(*_words: object, **_options: object) -> None:
        raise KeyError("translated")

    monkeypatch.setattr("cpunet.jobs.inspection.info.describe", fail)
    for words in (("--debug", "info", "x"), ("info", "x", "--debug")):
        outcome = command(*words)
        assert outcome.code == 70
        assert "Traceback" in outcome.err
        assert outcome.err.splitlines()[-1].startswith("error: ")


def test_after_two_dashes_debug_is_a_name(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = command("info", "--", "--debug")
    assert outcome.code == 2
    assert outcome.err.startswith("error: --debug: ")


def test_the_words_of_a_calibration_without_our_signs():
    prepare_streams()
    titles = "\n".join(f"{words} {unit}" for words, unit in TITLES.values())
    told = titles.encode("ascii", errors="cpunet.plain").decode()
    assert "impurity tilt [10^10/cm^4]" in told
    assert "\\" not in told
    words = Direction({"bias_V": 0.8, "temperature_K": -0.6}, 0.1).words
    assert words.encode("ascii", errors="cpunet.plain") == b"0.80 bias_V - 0.60 temperature_K"


def test_the_file_that_was_being_read_is_named(command, monkeypatch, stand):
    def fail(*_words: object, **_options: object) -> None:
        raise IndexError("no such row")

    monkeypatch.setattr("lh5.read_n_rows", fail)
    outcome = command("info", stand.sim)
    assert outcome.code == 70
    assert outcome.err.startswith(f"error: {stand.sim}: cpunet ")


def test_damaged_compiled_code_is_named(command, monkeypatch, tmp_path):
    from numba.core.caching import IndexDataCacheFile

    files = IndexDataCacheFile(str(tmp_path), "loop", "stamp")
    (tmp_path / "loop.nbi").write_bytes(b"\xff" * 9)

    def fail(*_words: object, **_options: object) -> None:
        files._load_index()

    monkeypatch.setattr("cpunet.jobs.inspection.info.describe", fail)
    with pytest.raises((pickle.UnpicklingError, ValueError)):
        fail()
    outcome = command("info", "x")
    assert (outcome.code, outcome.err.count("\n")) == (2, 1)
    assert f"{tmp_path / 'loop.nbi'}: damaged compiled code; remove it" in outcome.err


@pytest.mark.parametrize(
    ("name", "value", "dropped"),
    [
        ("OMP_NUM_THREADS", "abc", True),
        ("OMP_NUM_THREADS", "4,2", False),
        ("OMP_NUM_THREADS", "", True),
        ("NUMBA_NUM_THREADS", "0", True),
        ("NUMBA_NUM_THREADS", "2", False),
        ("NUMBA_NUM_THREADS", "1" * 6000, True),
        ("MKL_NUM_THREADS", "-1", True),
        ("OPENBLAS_NUM_THREADS", "1e3", True),
        ("OMP_THREAD_LIMIT", "99999999", True),
    ],
)
def test_numbers_of_threads_that_are_none(monkeypatch, name, value, dropped):
    monkeypatch.setenv(name, value)
    told = drop_nonsense()
    assert [line.startswith(f"{name}=") for line in told] == [True] * dropped
    assert (name in os.environ) != dropped
    assert all(len(line) < 120 for line in told)


def test_a_folder_of_code_that_others_can_write_to(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "to be made"))
    assert drop_nonsense() == []
    tmp_path.chmod(0o777)
    (line,) = drop_nonsense()
    assert "can be written by others; it is ignored" in line
    assert "NUMBA_CACHE_DIR" not in os.environ


def run(*words: object, **options: object) -> subprocess.CompletedProcess[str]:
    environment = os.environ | dict(options.pop("env", {}))  # type: ignore[call-overload]
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *map(os.fspath, words)],
        env=environment,
        text=True,
        check=False,
        **({"capture_output": True} | options),  # type: ignore[call-overload]
    )


@pytest.mark.thorough
def test_a_screen_without_our_signs(stand):
    told = run("info", stand.sim, env={"PYTHONIOENCODING": "ascii", "LC_ALL": "C"})
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout.isascii()
    assert "..." in told.stdout


@pytest.mark.thorough
def test_results_that_cannot_be_printed(stand):
    """A full disk, a closed stream, and a reader who is gone."""
    with Path("/dev/full").open("w") as full:
        told = run("info", stand.sim, stdout=full, stderr=subprocess.PIPE, capture_output=False)
    assert told.returncode == 2
    assert told.stderr == (
        "error: standard output: cannot be written (No space left on device)\n"
    )
    command = [sys.executable, "-c", PROGRAM, "--version"]
    line = " ".join(f"'{word}'" for word in command)
    closed = subprocess.run(
        f"{line} >&-", shell=True, capture_output=True, text=True, check=False
    )
    assert closed.returncode == 2
    assert closed.stderr == "error: standard output: cannot be written (it is closed)\n"
    reading, writing = os.pipe()
    os.close(reading)
    try:
        gone = run("--version", stdout=writing, stderr=subprocess.PIPE, capture_output=False)
    finally:
        os.close(writing)
    assert gone.returncode == 141
    assert gone.stderr == "error: standard output: its reader has stopped reading\n"


def test_an_output_is_in_place_even_if_nobody_can_be_told(monkeypatch):
    """What was written is whole: a warning, once, and no failure."""

    def refuse(*_words: object, **_options: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(messages, "out", Results())
    monkeypatch.setattr(messages, "err", Notes(stderr=True))
    monkeypatch.setattr("rich.console.Console._write_buffer", refuse)
    with monkeypatch.context() as patched:
        lines: list[str] = []
        patched.setattr(messages, "warn", lines.append)
        messages.tell("out.lh5: 3 pulses")
        messages.tell("more")
    assert lines == [
        "standard output: cannot be written (No space left on device); the output is whole"
    ]
    messages.fail("a log that is full stops nothing")


@pytest.mark.thorough
def test_names_that_are_no_text(tmp_path):
    name = os.fsencode(tmp_path) + b"/\xff\xfe.lh5"
    Path(os.fsdecode(name)).write_bytes(b"no pulses")
    told = run("info", os.fsdecode(name))
    assert told.returncode == 2
    assert told.stdout == ""
    assert told.stderr.startswith("error: ")
    assert "\\udcff" in told.stderr
    assert told.stderr.count("\n") == 1


def test_names_that_are_too_long(command, tmp_path):
    name = tmp_path / ("x" * 5000)
    outcome = command("info", name)
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err.count("\n") == 1
    assert "File name too long" in outcome.err
