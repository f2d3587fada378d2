"""Outputs appear whole or not at all, and replace nothing that the user did not mean.

A file or folder is written under a hidden name next to its destination, and moved when it
is complete.  No output is an input.  What exists is replaced only with ``--force``, a folder
only if this program made it and nothing else is in it: `MARKER` lists its files.
"""

from __future__ import annotations

import glob
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from cpunet.errors import CpunetError

MARKER = ".cpunet.json"
PICTURE_FORMATS = (".png", ".pdf", ".svg")

Given = Path | str | None


@dataclass(frozen=True)
class FolderKind:
    """A kind of output folder of this program.

    Parameters
    ----------
    name
        Name of the kind; a folder is replaced only by one of the same kind.
    command
        Command that creates the folder.
    own
        Regular expression of names of the program's files, relative to the folder, that may
        come into it later.
    """

    name: str
    command: str
    own: str


def refuse_inputs(out: Path, *inputs: Given) -> None:
    """Raise a `CpunetError` if an output is, contains, or lies in an input.

    Parameters
    ----------
    out
        File or folder to be written; it need not exist.
    inputs
        Files and folders as given by the user, including ``FILE:table`` and patterns; values
        that are not file names (a preset, None) are ignored.
    """
    place, sources = Path(out).resolve(), list[Path]()
    for text in map(str, filter(None, inputs)):
        file = next((f for f in (text, text.rpartition(":")[0]) if os.path.lexists(f)), None)
        names = [file] if file else glob.glob(text, recursive=True)  # noqa: PTH207 absolute, too
        sources += map(Path, names)
    for source in sources:
        real = source.resolve()
        if _same(place, real):
            raise CpunetError(f"{out}: is the input; choose another `out`")
        if any(_same(place, above) for above in real.parents):
            raise CpunetError(f"{out}: holds the input {source}; choose another `out`")
        if any(_same(above, real) for above in place.parents):
            raise CpunetError(f"{out}: lies in the input {source}; choose another `out`")


def _same(path: Path, other: Path) -> bool:
    """Whether two resolved paths are the same file, also under different names."""
    with suppress(OSError):
        return path == other or path.samefile(other)
    return False


def refuse_existing(target: Path, *inputs: Given, force: bool = False) -> None:
    """Raise a `CpunetError` if `target` exists and `force` is off, or like `refuse_inputs`."""
    refuse_inputs(target, *inputs)
    if target.exists() and not force:
        raise CpunetError(f"{target}: exists already; choose another name or give `force`")


def refuse_picture(target: Path, *inputs: Given, force: bool = False) -> None:
    """Raise a `CpunetError` if no picture can be made there, or like `refuse_existing`."""
    refuse_existing(target, *inputs, force=force)
    if target.suffix.lower() not in PICTURE_FORMATS:
        raise CpunetError(f"{target}: pictures are made as {', '.join(PICTURE_FORMATS)}")


def require_replaceable(target: Path, kind: FolderKind) -> None:
    """Raise a `CpunetError` unless `target` is missing, empty, or a folder of this kind.

    In the folder only what the marker lists, and the kind's own files, may be.
    """
    empty = target.is_dir() and not any(target.iterdir())
    try:
        content = json.loads((target / MARKER).read_text(encoding="utf-8"))
        made, files = content["kind"], content["files"]
    except (OSError, ValueError, LookupError, TypeError):
        made, files = "", []
    if target.exists() and not (empty or made == kind.name):
        raise CpunetError(
            f"{target}: is no folder that {kind.command} made, so `force` does not replace it; "
            "choose another name"
        )
    for name in _names(target):
        if name not in {MARKER, *files} and not re.fullmatch(kind.own, name):
            raise CpunetError(
                f"{target}: holds {name}, which cpunet did not write; move it elsewhere, or "
                "choose another name"
            )


def mark(folder: Path, kind: FolderKind) -> None:
    """Write the marker into a folder, with all present files as its own."""
    content = {"kind": kind.name, "files": _names(folder)}
    (folder / MARKER).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


@contextmanager
def written_aside(target: Path) -> Iterator[Path]:
    """Yield a temporary file name next to `target`; on success, move the file to `target`.

    On an exception the temporary file is removed and `target` is unchanged.

    Raises
    ------
    CpunetError
        If `target` cannot be written.
    """
    target = Path(target)
    aside = target.parent / f".{target.stem}-{secrets.token_hex(4)}.partial{target.suffix}"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        aside.touch(exist_ok=False)
        yield aside
        aside.replace(target)
    except OSError as error:
        raise not_written(error, target, aside) from error
    finally:
        with suppress(OSError):
            aside.unlink(missing_ok=True)


@contextmanager
def folder_written_aside(
    target: Path, kind: FolderKind, *inputs: Given, force: bool = False
) -> Iterator[Path]:
    """Yield a temporary folder next to `target`; on success, move it to `target`.

    Parameters
    ----------
    target
        Folder to create.
    kind
        Kind of the folder.
    inputs
        Files and folders that are read; `target` must not be, contain or lie in any of them.
    force
        Whether to replace an empty folder, or one of this kind; see `require_replaceable`.

    Raises
    ------
    CpunetError
        If `target` exists and must not be replaced, or cannot be written.
    """
    target = Path(target)
    refuse_existing(target, *inputs, force=force)
    require_replaceable(target, kind)
    place = target.resolve() if target.is_symlink() else target
    aside = place.parent / f".{place.name}-{secrets.token_hex(4)}"
    old = aside.with_name(f"{aside.name}-old")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        aside.mkdir()
        yield aside
        mark(aside, kind)
        if force and place.exists():
            require_replaceable(place, kind)  # the user may have come meanwhile
            place.replace(old)
        aside.replace(place)
    except OSError as error:
        raise not_written(error, target, aside) from error
    finally:
        if old.exists() and not place.exists():
            old.replace(place)
        for path in (aside, old):
            shutil.rmtree(path, ignore_errors=True)


def not_written(error: OSError, target: Path, aside: Path) -> CpunetError:
    """Describe why `target` was not written at `aside`; another file that failed is named."""
    reason = os.strerror(error.errno) if error.errno else str(error)
    other = str(error.filename or aside)
    what = "" if aside.name in other else f", {other}"
    return CpunetError(
        f"{target}: cannot be written ({reason}{what}); make room there, or choose another "
        "place"
    )


def _names(folder: Path) -> list[str]:
    """Names of the files and links below a folder, relative to it, in order."""
    paths = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path.relative_to(folder).as_posix() for path in paths)
