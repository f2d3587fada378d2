"""Outputs appear whole or not at all: written aside, then moved into place."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cpunet.errors import CpunetError


@contextmanager
def written_aside(target: Path) -> Iterator[Path]:
    """Give a temporary file name beside `target`; move it there if all went well.

    On an exception the temporary file is removed and `target` is as it was.

    Raises
    ------
    CpunetError
        If the folder of `target` cannot be written to.
    """
    target = Path(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{target.stem}-", suffix=f".partial{target.suffix}", dir=target.parent
        )
    except OSError as error:
        raise CpunetError(f"{target}: cannot be written ({error.strerror})") from error
    os.close(handle)
    aside = Path(name)
    try:
        yield aside
        aside.chmod(0o666 & ~_umask())
        aside.replace(target)
    except OSError as error:
        raise CpunetError(f"{target}: cannot be written ({error.strerror or error})") from error
    finally:
        aside.unlink(missing_ok=True)


@contextmanager
def folder_written_aside(target: Path, *, force: bool = False) -> Iterator[Path]:
    """Give a temporary folder beside `target`; move it there if all went well.

    Raises
    ------
    CpunetError
        If `target` exists and `force` is off, or its parent cannot be written to.
    """
    target = Path(target)
    refuse_existing(target, force=force)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        raise CpunetError(f"{target}: cannot be written ({error.strerror})") from error
    try:
        yield aside
        aside.chmod(0o777 & ~_umask())
        if target.is_dir():
            shutil.rmtree(target)
        aside.replace(target)
    except OSError as error:
        raise CpunetError(f"{target}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def refuse_existing(target: Path, *, force: bool = False) -> None:
    """Raise a `CpunetError` if `target` is there already and `force` is off."""
    if target.exists() and not force:
        raise CpunetError(f"{target}: exists already; choose another name or give --force")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
