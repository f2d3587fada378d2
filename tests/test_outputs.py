"""Outputs appear whole or not at all; no input and no file of the user is replaced."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import pytest

from cpunet.errors import CpunetError
from cpunet.outputs import (
    MARKER,
    FolderKind,
    folder_written_aside,
    refuse_existing,
    refuse_inputs,
    require_replaceable,
    written_aside,
)

RUN = FolderKind("run", "cpunet train", r"run\.json|log/[ab]")
run_folder_aside = partial(folder_written_aside, kind=RUN, force=True)
REPORT = FolderKind("report", "cpunet validate", r"metrics\.json")


def tree(folder: Path) -> dict[str, str]:
    """What the files below a folder hold, but for the markers."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(folder)): path.read_text() for path in files if path.name != MARKER
    }


def make(folder: Path, kind: FolderKind = RUN, **files: str) -> None:
    """Have the program make a folder, over an old one."""
    with folder_written_aside(folder, kind, force=True) as aside:
        for name, text in files.items():
            path = aside / name.replace("__", "/").replace("_", ".")
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)


@pytest.mark.parametrize("old", [None, "old"])
def test_a_file_appears_at_the_end(tmp_path, old):
    target = tmp_path / "new" / "out.lh5"
    if old is not None:
        target.parent.mkdir()
        target.write_text(old)
    with written_aside(target) as aside:
        aside.write_text("content")
        assert (aside.parent, aside.suffix) == (target.parent, ".lh5")
        assert target.exists() == (old is not None)
    assert tree(tmp_path) == {"new/out.lh5": "content"}


@pytest.mark.parametrize("error", [ValueError, CpunetError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("writer", [written_aside, run_folder_aside])
def test_what_failed_leaves_what_was_there(tmp_path, error, old, writer):
    target = tmp_path / "out"
    if old and writer is written_aside:
        target.write_text("old")
    elif old:
        make(target, run_json="old")
    before = tree(tmp_path)

    def fail():
        with writer(target) as aside:
            (aside if aside.is_file() else aside / "half").write_text("half")
            raise error("stop")

    with pytest.raises(error, match="stop"):
        fail()
    assert tree(tmp_path) == before


def test_a_move_that_fails_brings_the_old_folder_back(tmp_path, monkeypatch):
    make(tmp_path / "run", run_json="old")
    replace = Path.replace

    def fail(path, to):
        if to == tmp_path / "run" and not path.name.endswith("-old"):
            raise OSError(5, "Input/output error")
        return replace(path, to)

    monkeypatch.setattr("pathlib.Path.replace", fail)
    with pytest.raises(CpunetError, match="Input/output error"):
        make(tmp_path / "run", run_json="new")
    assert tree(tmp_path) == {"run/run.json": "old"}


@pytest.mark.parametrize(
    ("out", "given", "told"),
    [
        ("data/raw.lh5", "data/raw.lh5", "is the input"),
        ("data/../data/raw.lh5", "data/raw.lh5", "is the input"),
        ("data/raw.lh5", "linked.lh5", "is the input"),
        ("linked.lh5", "data/raw.lh5", "is the input"),
        ("hard.lh5", "data/raw.lh5", "is the input"),
        ("data/raw.lh5", "data/raw.lh5:ch1/raw", "is the input"),
        ("data/raw.lh5", "**/*.lh5", "is the input"),
        (".", "data/raw.lh5", "holds the input"),
        ("elsewhere", "data/raw.lh5", "holds the input"),  # a link to the folder
        ("data", "data/raw.lh5:ch1/raw", "holds the input"),
        ("data/new/out.lh5", "data", "lies in the input"),
        ("elsewhere/out.lh5", "data", "lies in the input"),
    ],
)
def test_an_input_is_refused(tmp_path, monkeypatch, out, given, told):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "raw.lh5").write_text("pulses")
    (tmp_path / "linked.lh5").symlink_to("data/raw.lh5")
    os.link("data/raw.lh5", "hard.lh5")
    (tmp_path / "elsewhere").symlink_to("data")
    with pytest.raises(CpunetError, match=f"^{out}: {told}.*; choose another `out`$"):
        refuse_existing(Path(out), None, given, force=True)


@pytest.mark.parametrize("given", [None, "", "icpc", "none.lh5", "data/raw.lh5:x", "*.none"])
def test_what_is_no_input_is_free(tmp_path, monkeypatch, given):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "raw.lh5").touch()
    (tmp_path / "raw").mkdir()  # the beginning of a name is not the name
    refuse_inputs(Path("data/out.lh5"), given)
    refuse_inputs(Path("raw.lh5"), "raw", given)


def test_a_folder_is_replaced_only_with_force(tmp_path):
    run = tmp_path / "run"
    make(run, run_json="old", log__a="old")
    with (
        pytest.raises(CpunetError, match="exists already; choose another name or give `force`"),
        folder_written_aside(run, RUN),
    ):
        pytest.fail("entered")
    make(run, run_json="new", log__b="new")
    assert tree(tmp_path) == {"run/run.json": "new", "run/log/b": "new"}


@pytest.mark.parametrize("mine", ["thesis.tex", "log/notes.txt", "link"])
def test_a_folder_that_holds_a_file_of_the_user_is_not_replaced(tmp_path, mine):
    run = tmp_path / "run"
    make(run, run_json="old", log__a="old")
    (run / mine).symlink_to("run.json") if mine == "link" else (run / mine).touch()
    before = tree(run)
    with pytest.raises(CpunetError, match=f"run: holds {mine}, which cpunet did not write; "):
        make(run, run_json="new")
    assert tree(run) == before


def test_a_file_that_comes_meanwhile_is_not_lost(tmp_path):
    run = tmp_path / "run"
    make(run, run_json="old")
    with pytest.raises(CpunetError, match=r"holds thesis\.tex"), run_folder_aside(run):
        (run / "thesis.tex").touch()
    assert tree(run) == {"run.json": "old", "thesis.tex": ""}


def test_other_folders_are_not_replaced(tmp_path):
    target = tmp_path / "home"
    require_replaceable(target, RUN)
    target.mkdir()
    require_replaceable(target, RUN)
    (target / "thesis.tex").touch()
    make(tmp_path / "report", REPORT, metrics_json="{}")
    (tmp_path / "file").touch()
    for other in (target, tmp_path / "report", tmp_path / "file"):
        with pytest.raises(CpunetError, match="no folder that cpunet train made, so `force`"):
            make(other, run_json="new")
    assert tree(target) == {"thesis.tex": ""}


def test_a_linked_folder_is_replaced_in_its_place(tmp_path):
    make(tmp_path / "disk" / "run", run_json="old")
    (tmp_path / "run").symlink_to("disk/run")
    make(tmp_path / "run", run_json="new")
    assert (tmp_path / "run").is_symlink()
    assert tree(tmp_path / "disk") == {"run/run.json": "new"}
