"""Rules for replacing outputs: never an input, and in a folder only what this program wrote.

Every output folder contains `MARKER`, which lists the program, the command and the files that
it wrote.  With ``--force`` these files are replaced; all others are kept.
"""

from __future__ import annotations

import glob
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from cpunet.errors import CpunetError

MARKER = ".cpunet.json"
PROGRAM = "cpunet"

Note = Callable[[str], None]
Given = Path | str | None

PICTURE_FORMATS = (".png", ".pdf", ".svg")


@dataclass(frozen=True)
class FolderKind:
    """A kind of output folder of this program.

    Parameters
    ----------
    name
        Name of the kind; a folder is replaced only by one of the same kind.
    command
        Command that creates the folder.
    known_by
        Name of a file in every such folder, which identifies folders without a marker.
    own
        Regular expression of file names, relative to the folder, that always belong to the
        program.
    older
        Regular expression of further such names in folders without a list of their files.
    """

    name: str
    command: str
    known_by: str
    own: str
    older: str = "(?!)"  # none


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
    place = resolved(Path(out))
    for source in (found for given in inputs for found in _named(given)):
        real = resolved(source)
        if _same(place, real):
            raise CpunetError(f"{out}: is the input; choose another --out")
        if any(_same(place, above) for above in real.parents):
            raise CpunetError(f"{out}: holds the input {source}; choose another --out")
        if any(_same(above, real) for above in place.parents):
            raise CpunetError(f"{out}: lies in the input {source}; choose another --out")


def resolved(path: Path) -> Path:
    """A path with all links resolved.

    Raises
    ------
    CpunetError
        If the links form a loop.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError) as error:  # before Python 3.13, the latter
        raise CpunetError(f"{path}: is a link that leads in a circle; remove it") from error


def refuse_existing(target: Path, *inputs: Given, force: bool = False) -> None:
    """Raise a `CpunetError` if `target` exists and `force` is off, or like `refuse_inputs`.

    A dangling link is neither written through nor replaced.
    """
    refuse_inputs(target, *inputs)
    if target.is_symlink() and not target.exists():
        raise CpunetError(f"{target}: is a link that leads nowhere; remove it")
    if target.exists() and not force:
        raise CpunetError(f"{target}: exists already; choose another name or give --force")


def require_replaceable(target: Path, kind: FolderKind) -> None:
    """Raise a `CpunetError` if `target` exists but must not be replaced.

    Only an empty folder, or one of the same kind made by this program, can be replaced.
    """
    if not target.exists():
        return
    if not (target.is_dir() and (made_here(target, kind) or not any(target.iterdir()))):
        raise CpunetError(
            f"{target}: is no folder with a {kind.known_by} that {kind.command} made, so "
            "--force does not replace it; choose another name"
        )


def made_here(folder: Path, kind: FolderKind) -> bool:
    """Whether a folder was made by this program and is of the given kind."""
    if (folder / MARKER).is_file():
        return _marker(folder).get("kind") == kind.name
    return (folder / kind.known_by).is_file()


def mark(folder: Path, kind: FolderKind, *, listed: bool = True) -> None:
    """Write the marker into a folder; if `listed`, with all present files as its own."""
    content: dict[str, object] = {
        "program": PROGRAM,
        "command": kind.command,
        "kind": kind.name,
    }
    if listed:
        content["files"] = sorted(_relative(path, folder) for path in _leaves(folder))
    (folder / MARKER).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def keep_others(old: Path, new: Path, kind: FolderKind) -> list[str]:
    """Transfer files that are not the program's own from a folder to its replacement.

    They are linked, or copied where links are impossible, so that nothing is ever lost.  If
    the name of a new file is taken, the old file gets the suffix ``.kept``.

    Returns
    -------
    list of str
        Names of the kept files, relative to the folder.
    """
    kept = []
    # first the files that keep their names
    for path in sorted(_others(old, kind), key=lambda p: (new / p.relative_to(old)).exists()):
        place = new / path.relative_to(old)
        while os.path.lexists(place):
            place = place.with_name(f"{place.name}.kept")
        place.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir() and not path.is_symlink():
            place.mkdir()
        else:
            try:
                os.link(path, place, follow_symlinks=False)
            except OSError:
                shutil.copy2(path, place, follow_symlinks=False)
        kept.append(_relative(place, new))
    return kept


def copy_own(folder: Path, to: Path, kind: FolderKind) -> None:
    """Copy the files whose names match ``own`` of the kind from one folder to another."""
    own = re.compile(kind.own)
    for path in _leaves(folder):
        if own.fullmatch(_relative(path, folder)) and path.is_file():
            place = to / path.relative_to(folder)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, place)


def remove_own(folder: Path, kind: FolderKind) -> list[str]:
    """Remove the program's files from a folder, and the folder if nothing else is in it.

    Returns
    -------
    list of str
        Names of the kept files, relative to the folder; if any are kept, so is the marker.
    """
    folder = folder.resolve()  # a link stays
    others = list(_others(folder, kind))
    staying = {above for path in others for above in (path, *path.parents)}
    for path in list(_leaves(folder)):
        if path not in staying:
            path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
            for above in path.parents:
                if above == folder or above in staying or any(above.iterdir()):
                    break
                above.rmdir()
    if others:
        (folder / MARKER).unlink(missing_ok=True)
        mark(folder, kind, listed=False)
    elif not any(folder.iterdir()):
        folder.rmdir()
    return [_relative(path, folder) for path in others]


def told_kept(folder: Path, kept: list[str], note: Note) -> None:
    """Report the files of a folder that were kept, if any."""
    if kept:
        shown = ", ".join(kept[:5]) + (f" and {len(kept) - 5} more" if kept[5:] else "")
        note(f"{folder}: kept what cpunet did not write: {shown}")


def _named(given: Given) -> Iterator[Path]:
    """Existing files and folders that a command-line argument refers to."""
    if given is None or str(given) == "":
        return
    path = Path(given)
    text = str(given)
    if os.path.lexists(path):
        yield path
    elif (file := text.rpartition(":")[0]) and os.path.lexists(file):
        yield Path(file)
    elif glob.has_magic(text):
        yield from map(Path, glob.glob(text, recursive=True))  # noqa: PTH207 (absolute ones too)


def _same(one: Path, other: Path) -> bool:
    """Whether two resolved paths are the same file, also under different names."""
    try:
        return one == other or one.samefile(other)
    except OSError:
        return False


def _marker(folder: Path) -> dict[str, object]:
    try:
        content = json.loads((folder / MARKER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    ours = isinstance(content, dict) and content.get("program") == PROGRAM
    return content if ours else {}


def _leaves(folder: Path) -> Iterator[Path]:
    """Files, links and empty folders below a folder."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.is_symlink() and any(path.iterdir()):
            yield from _leaves(path)
        else:
            yield path


def _others(folder: Path, kind: FolderKind) -> Iterator[Path]:
    """Paths in a folder that are not the program's own."""
    marker = _marker(folder)
    files = marker.get("files")
    listed = (
        {file for file in files if isinstance(file, str)} if isinstance(files, list) else set()
    )
    own = re.compile(kind.own if isinstance(files, list) else f"{kind.own}|{kind.older}")
    for path in _leaves(folder):
        name = _relative(path, folder)
        if name != MARKER and name not in listed and not own.fullmatch(name):
            yield path


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()
