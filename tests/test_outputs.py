"""An output replaces no input, and of a folder only what the program wrote."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from cpunet.errors import CpunetError
from cpunet.files import folder_written_aside
from cpunet.outputs import (
    MARKER,
    FolderKind,
    copy_own,
    refuse_existing,
    refuse_inputs,
    remove_own,
    require_replaceable,
)

RUN = FolderKind("run", "cpunet train", "run.json", r"run\.json|log/[ab]", older=r".*\.png")
REPORT = FolderKind("report", "cpunet validate", "metrics.json", r"metrics\.json")


def tree(folder: Path) -> dict[str, str | None]:
    """Every path below a folder but the markers, and what files hold."""
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
        if path.name != MARKER
        and (path.is_symlink() or not path.is_dir() or not any(path.iterdir()))
    }


def make(folder: Path, kind: FolderKind = RUN, notes: list[str] | None = None, **files: str):
    """Have the program make a folder, over an old one."""
    said = [] if notes is None else notes
    with folder_written_aside(folder, kind, force=True, note=said.append) as aside:
        for name, text in files.items():
            path = aside / name.replace("__", "/").replace("_", ".")
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)


@pytest.mark.parametrize(
    ("out", "given", "told"),
    [
        ("data/raw.lh5", "data/raw.lh5", "is the input"),
        ("data/../data/raw.lh5", "data/raw.lh5", "is the input"),
        ("data/raw.lh5", "linked.lh5", "is the input"),
        ("linked.lh5", "data/raw.lh5", "is the input"),
        ("hard.lh5", "data/raw.lh5", "is the input"),
        ("data/raw.lh5", "data/raw.lh5:ch1/raw", "is the input"),
        ("data/raw.lh5", "data/*.lh5", "is the input"),
        ("data/raw.lh5", "**/*.lh5", "is the input"),
        ("data", "data/raw.lh5", "holds the input"),
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
    with pytest.raises(CpunetError, match=f"^{out}: {told}.*; choose another --out$"):
        refuse_inputs(Path(out), None, given)
    with pytest.raises(CpunetError, match=told):
        refuse_existing(Path(out), given, force=True)


@pytest.mark.parametrize("given", [None, "", "icpc", "none.lh5", "data/raw.lh5:x", "*.none"])
def test_what_is_no_input_is_free(tmp_path, monkeypatch, given):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "raw.lh5").touch()
    (tmp_path / "raw").mkdir()  # the beginning of a name is not the name
    refuse_inputs(Path("data/out.lh5"), given)
    refuse_inputs(Path("raw.lh5"), "raw", given)


def test_refuse_existing(tmp_path):
    refuse_existing(tmp_path / "none")
    refuse_existing(tmp_path, force=True)
    with pytest.raises(CpunetError, match="--force"):
        refuse_existing(tmp_path)


def test_what_others_wrote_is_kept_and_told(tmp_path):
    run, notes = tmp_path / "run", []
    make(run, run_json="old", log__a="old", plot_png="old")
    (run / "thesis").mkdir()
    (run / "thesis" / "chapter.tex").write_text("mine")
    (run / "photo.png").write_text("mine")
    (run / "link").symlink_to("thesis")
    (run / "empty").mkdir()
    make(run, notes=notes, run_json="new")
    assert tree(run) == {
        "empty": None,
        "link": None,
        "photo.png": "mine",
        "run.json": "new",
        "thesis/chapter.tex": "mine",
    }
    assert (run / "link").is_symlink()
    assert notes == [
        f"{run}: kept what cpunet did not write: empty, link, photo.png, thesis/chapter.tex"
    ]
    make(run, run_json="newer")  # what was kept once stays the user's
    assert tree(run)["photo.png"] == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_name_that_is_the_programs_now(tmp_path):
    run = tmp_path / "run"
    make(run, run_json="old")
    (run / "spectrum.png").write_text("mine")
    (run / "spectrum.png.kept").write_text("mine, too")
    make(run, run_json="new", spectrum_png="new")
    assert tree(run) == {
        "run.json": "new",
        "spectrum.png": "new",
        "spectrum.png.kept": "mine, too",
        "spectrum.png.kept.kept": "mine",
    }


def test_files_of_the_programs_own_folders(tmp_path):
    run = tmp_path / "run"
    make(run, run_json="old", log__a="old")
    (run / "log" / "notes.txt").write_text("mine")
    make(run, run_json="new", log__b="new")
    assert tree(run) == {"log/b": "new", "log/notes.txt": "mine", "run.json": "new"}


def test_an_older_folder_is_known_by_its_file(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    for name in ("run.json", "loss.png", "thesis.tex"):
        (run / name).write_text("old")
    make(run, run_json="new")
    assert tree(run) == {"run.json": "new", "thesis.tex": "old"}
    marker = json.loads((run / MARKER).read_text())
    assert (marker["program"], marker["command"]) == ("cpunet", "cpunet train")
    assert marker["files"] == ["run.json"]


def test_other_folders_are_not_replaced(tmp_path):
    target = tmp_path / "home"
    require_replaceable(target, RUN)
    target.mkdir()
    require_replaceable(target, RUN)
    (target / "thesis.tex").touch()
    with pytest.raises(CpunetError, match=r"is no folder with a run\.json that cpunet train"):
        make(target, run_json="new")
    make(tmp_path / "report", REPORT, metrics_json="{}")
    (tmp_path / "report" / "run.json").touch()
    with pytest.raises(CpunetError, match="is no folder"):
        require_replaceable(tmp_path / "report", RUN)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / MARKER).write_text('{"kind": "run", "program": "other"}')
    with pytest.raises(CpunetError, match="is no folder"):
        require_replaceable(tmp_path / "foreign", RUN)
    assert tree(target) == {"thesis.tex": ""}


def test_a_linked_folder_is_replaced_in_its_place(tmp_path):
    make(tmp_path / "disk" / "run", run_json="old")
    (tmp_path / "disk" / "run" / "mine").write_text("mine")
    (tmp_path / "run").symlink_to("disk/run")
    make(tmp_path / "run", run_json="new")
    assert (tmp_path / "run").is_symlink()
    assert tree(tmp_path / "disk") == {"run/mine": "mine", "run/run.json": "new"}


def test_what_failed_changes_nothing(tmp_path):
    run = tmp_path / "run"
    make(run, run_json="old")
    (run / "mine").write_text("mine")

    def fail():
        with folder_written_aside(run, RUN, force=True) as aside:
            (aside / "run.json").write_text("new")
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert tree(tmp_path) == {"run/mine": "mine", "run/run.json": "old"}


def test_remove_own(tmp_path):
    run = tmp_path / "run"
    make(run, run_json="old", log__a="old")
    assert remove_own(run, RUN) == []
    assert not run.exists()
    make(run, run_json="old", log__a="old")
    (run / "mine" / "log").mkdir(parents=True)
    (run / "mine" / "log" / "a").write_text("mine")
    assert remove_own(run, RUN) == ["mine/log/a"]
    assert tree(run) == {"mine/log/a": "mine"}
    make(run, run_json="new")  # it is still a folder that the program may fill
    assert tree(run) == {"mine/log/a": "mine", "run.json": "new"}


def test_copy_own(tmp_path):
    make(tmp_path / "run", run_json="a", log__b="b")
    (tmp_path / "run" / "mine").touch()
    copy_own(tmp_path / "run", tmp_path / "copy", RUN)
    assert tree(tmp_path / "copy") == {"log/b": "b", "run.json": "a"}
