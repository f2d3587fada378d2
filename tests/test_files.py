"""Outputs appear whole or not at all, and nothing else is left in the folder."""

from __future__ import annotations

import stat
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpunet.errors import CpunetError
from cpunet.files import folder_written_aside as aside_of_kind
from cpunet.files import written_aside
from cpunet.outputs import MARKER, FolderKind, mark
from cpunet.training.unfinished import unfinished_folder

KIND = FolderKind("thing", "cpunet make", known_by="old", own="old|new")


def folder_written_aside(target, *, force=False):
    return aside_of_kind(target, KIND, force=force)


def listing(folder: Path) -> list[str]:
    """Every name in a folder, hidden ones too, but for the marker that all folders have."""
    return sorted(path.name for path in folder.iterdir() if path.name != MARKER)


def test_a_file_appears_at_the_end(tmp_path):
    target = tmp_path / "new" / "folder" / "out.lh5"
    with written_aside(target) as aside:
        aside.write_bytes(b"content")
        assert aside.parent == target.parent
        assert aside.suffix == ".lh5"
        assert not target.exists()
    assert target.read_bytes() == b"content"
    assert listing(target.parent) == ["out.lh5"]


@pytest.mark.parametrize("error", [ValueError, CpunetError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("old", [None, b"old"])
def test_a_file_that_failed_leaves_no_trace(tmp_path, error, old):
    target = tmp_path / "out.lh5"
    if old is not None:
        target.write_bytes(old)

    def fail():
        with written_aside(target) as aside:
            aside.write_bytes(b"half")
            raise error("stop")

    with pytest.raises(error, match="stop"):
        fail()
    assert listing(tmp_path) == ([] if old is None else ["out.lh5"])
    if old is not None:
        assert target.read_bytes() == old


def test_an_existing_file_is_replaced(tmp_path):
    target = tmp_path / "out.lh5"
    target.write_bytes(b"old")
    with written_aside(target) as aside:
        aside.write_bytes(b"new")
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"


def test_a_file_has_the_permissions_of_any_other(tmp_path):
    with written_aside(tmp_path / "file") as aside:
        aside.touch()
    with folder_written_aside(tmp_path / "folder"):
        pass
    (tmp_path / "other").touch()
    (tmp_path / "others").mkdir()
    modes = [
        stat.S_IMODE((tmp_path / name).stat().st_mode)
        for name in ("file", "other", "folder", "others")
    ]
    assert modes[0] == modes[1]
    assert modes[2] == modes[3]


def test_a_folder_in_a_group_s_folder_belongs_to_the_group(tmp_path):
    """Of a folder with the set-group-ID bit, folders inherit the group and the bit."""
    tmp_path.chmod(0o2775)
    with folder_written_aside(tmp_path / "run"):
        pass
    assert (tmp_path / "run").stat().st_mode & stat.S_ISGID


def test_the_permissions_of_other_threads_files_never_change(tmp_path, monkeypatch):
    """The umask is the whole process's: what a thread opens meanwhile would be open to all."""
    monkeypatch.setattr("os.umask", lambda _mask: pytest.fail("changed"))
    with written_aside(tmp_path / "file"), folder_written_aside(tmp_path / "folder"):
        pass


@pytest.mark.parametrize("writer", [written_aside, folder_written_aside])
def test_a_place_that_cannot_be_written_to(tmp_path, writer):
    (tmp_path / "file").touch()
    target = tmp_path / "file" / "out"
    with pytest.raises(CpunetError) as error, writer(target):
        pass
    assert str(error.value).startswith(f"{target}: cannot be written (")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("writer", [written_aside, folder_written_aside, unfinished_folder])
def test_another_file_that_failed_is_named(tmp_path, writer):
    missing, target = tmp_path / "sim.lh5", tmp_path / "out"
    with pytest.raises(CpunetError) as error, writer(target):
        missing.read_bytes()
    said = str(error.value)
    assert said.startswith(f"{missing}: cannot be used (No such file or directory); {target}")
    assert listing(tmp_path) == []


@pytest.mark.parametrize("writer", [folder_written_aside, unfinished_folder])
def test_a_file_inside_the_output_is_the_output(tmp_path, monkeypatch, writer):
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(CpunetError, match=r"^out.*: cannot be written \(No such"),
        writer(Path("out")) as folder,
    ):
        (folder.absolute() / "nowhere" / "file").write_text("")


def test_a_full_disk_is_one_line(tmp_path):
    target = tmp_path / "out.lh5"
    with pytest.raises(CpunetError) as error, written_aside(target):
        raise OSError(28, "No space left on device")
    assert str(error.value) == f"{target}: cannot be written (No space left on device)"
    assert listing(tmp_path) == []


def test_a_folder_appears_at_the_end(tmp_path):
    target = tmp_path / "new" / "run"
    with folder_written_aside(target) as aside:
        (aside / "run.json").write_text("{}")
        assert not target.exists()
    assert listing(target) == ["run.json"]
    assert listing(target.parent) == ["run"]


@pytest.mark.parametrize("error", [ValueError, CpunetError, KeyboardInterrupt])
@pytest.mark.parametrize("old", [False, True])
def test_a_folder_that_failed_leaves_no_trace(tmp_path, error, old):
    target = tmp_path / "run"
    if old:
        target.mkdir()
        (target / "old").touch()

    def fail():
        with folder_written_aside(target, force=True) as aside:
            (aside / "half").touch()
            raise error("stop")

    with pytest.raises(error, match="stop"):
        fail()
    assert listing(tmp_path) == (["run"] if old else [])
    if old:
        assert listing(target) == ["old"]


def test_an_existing_folder_is_refused_and_with_force_replaced(tmp_path):
    target = tmp_path / "run"
    target.mkdir()
    (target / "old").touch()
    with pytest.raises(CpunetError, match="exists already") as error:  # noqa: SIM117
        with folder_written_aside(target):
            pytest.fail("entered")
    assert str(error.value) == (
        f"{target}: exists already; choose another name or give --force"
    )
    assert listing(target) == ["old"]
    with folder_written_aside(target, force=True) as aside:
        (aside / "new").touch()
        assert listing(target) == ["old"]
    assert listing(target) == ["new"]
    assert listing(tmp_path) == ["run"]


@pytest.mark.parametrize("at_the_move", [True, False])
@pytest.mark.parametrize("own", [True, False])
def test_of_a_folder_that_appears_meanwhile_others_files_stay(
    tmp_path, monkeypatch, own, at_the_move
):
    target, replace, done = tmp_path / "run", Path.replace, list[bool]()

    def appear():
        if not done:
            done.append(True)
            target.mkdir()
            (target / "old").touch()
            mark(target, KIND)  # what is there now is the program's
            if not own:
                (target / "thesis.tex").touch()

    def after_another(path, to):
        if to == target:
            appear()
        return replace(path, to)

    monkeypatch.setattr("pathlib.Path.replace", after_another)
    with folder_written_aside(target) as aside:
        (aside / "new").touch()
        if not at_the_move:
            appear()
    assert listing(target) == (["new"] if own else ["new", "thesis.tex"])
    assert listing(tmp_path) == ["run"]


def test_a_file_in_the_place_of_a_folder_is_no_traceback(tmp_path):
    target = tmp_path / "run"
    target.touch()
    with pytest.raises(CpunetError, match="is no folder"):  # noqa: SIM117
        with folder_written_aside(target, force=True):
            pass
    assert listing(tmp_path) == ["run"]


NAME = st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1)


@given(name=NAME.filter(lambda n: n not in (".", "..") and len(n.encode()) < 200))
def test_any_name_that_a_file_may_have(name):
    with TemporaryDirectory() as folder:
        with written_aside(Path(folder) / name) as aside:
            aside.write_bytes(name.encode())
        assert (Path(folder) / name).read_bytes() == name.encode()
        assert listing(Path(folder)) == [name]
