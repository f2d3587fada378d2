"""Atomic outputs: written to a temporary path, then moved into place."""

from __future__ import annotations

import glob
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cpunet.errors import CpunetError
from cpunet.outputs import (
    FolderKind,
    Given,
    Note,
    keep_others,
    mark,
    refuse_existing,
    require_replaceable,
    told_kept,
)


@contextmanager
def written_aside(target: Path) -> Iterator[Path]:
    """Yield a temporary file name beside `target`; on success, move the file to `target`.

    On an exception the temporary file is removed and `target` is unchanged.

    Raises
    ------
    CpunetError
        If the folder of `target` is not writable.
    """
    target = Path(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = target.parent / f"{_hidden(target.stem)}.partial{target.suffix}"
        aside.touch(exist_ok=False)
    except OSError as error:
        raise CpunetError(f"{target}: cannot be written ({error.strerror})") from error
    try:
        yield aside
        aside.replace(target)
    except OSError as error:
        raise not_written(error, target, aside) from error
    finally:
        aside.unlink(missing_ok=True)


def not_written(error: OSError, target: Path, *places: Path) -> CpunetError:
    """Describe why `target` was not written; another file that failed is named instead.

    Parameters
    ----------
    error
        Error of the system. It names a file that cannot be opened, but not one that cannot be
        read or written.
    target
        File or folder to be written.
    places
        Further paths at which it is being written.
    """
    reason = error.strerror or error
    if isinstance(error.filename, str | bytes):
        failed = Path(os.fsdecode(error.filename)).absolute()
        own = {path.absolute() for path in (target, *places)}
        if own.isdisjoint((failed, *failed.parents)):
            return CpunetError(f"{failed}: cannot be used ({reason}); {target} is not written")
    return CpunetError(f"{target}: cannot be written ({reason})")


def remove_partial(target: Path) -> None:
    """Remove temporary files of killed processes; no process may be writing `target` now."""
    for left in target.parent.glob(f".{glob.escape(target.stem)}-*.partial{target.suffix}"):
        # the random part has no hyphen, unlike a longer name of another file
        if "-" not in left.name.removeprefix(f".{target.stem}-"):
            left.unlink(missing_ok=True)


@contextmanager
def folder_written_aside(
    target: Path,
    kind: FolderKind,
    *inputs: Given,
    force: bool = False,
    note: Note = lambda _message: None,
) -> Iterator[Path]:
    """Yield a temporary folder beside `target`; on success, move it to `target`.

    Parameters
    ----------
    target
        Folder to create.
    kind
        Kind of the folder.  With `force`, only an empty folder or one of the same kind is
        replaced, and in it only files that the program wrote.
    inputs
        Files and folders that are read; `target` must not be, contain or lie in any of them.
    force
        Whether to replace an existing folder.
    note
        Function called with a message about files kept from an old folder.

    Raises
    ------
    CpunetError
        If `target` exists and must not be replaced, or its parent is not writable.
    """
    target = Path(target)
    refuse_existing(target, *inputs, force=force)
    require_replaceable(target, kind)
    place = target.resolve() if target.is_symlink() else target
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        aside = place.parent / _hidden(place.name)
        aside.mkdir()
    except OSError as error:
        raise CpunetError(f"{target}: cannot be written ({error.strerror})") from error
    try:
        yield aside
        mark(aside, kind)
        kept = keep_others(place, aside, kind) if place.exists() else []
        _take_the_place(aside, place, kind)
        told_kept(target, kept, note)
    except OSError as error:
        raise not_written(error, target, place, aside) from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _take_the_place(aside: Path, target: Path, kind: FolderKind) -> None:
    """Rename `aside` to `target`; an old folder is removed only afterwards.

    A folder that another process has put there in the meantime is replaced, too.
    """
    if not target.exists():
        try:
            aside.replace(target)
        except OSError:
            if not target.exists():
                raise
            require_replaceable(target, kind)
            keep_others(target, aside, kind)
        else:
            return
    old = aside.with_name(f"{aside.name}-old")
    target.replace(old)
    try:
        aside.replace(target)
    except OSError:
        old.replace(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _hidden(name: str) -> str:
    """A name that no other process uses; its random part has no hyphen."""
    return f".{name}-{secrets.token_hex(4)}"
