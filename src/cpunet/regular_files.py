"""Inputs are regular files: a named pipe would be waited for, a device read without end."""

from __future__ import annotations

import stat
from pathlib import Path

from cpunet.errors import CpunetError


def require_file(path: Path | str) -> Path:
    """Return the path, unless something is there that is neither a file nor a folder.

    What is not there, or cannot be looked at, is left to whoever opens it.

    Raises
    ------
    CpunetError
        If it is a pipe, a socket or a device.
    """
    file = Path(path)
    try:
        mode = file.stat().st_mode
    except (OSError, ValueError):
        return file
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise CpunetError(f"{file}: is a pipe or a device, no file; copy it into a file first")
    return file


def is_there(name: Path | str) -> bool:
    """Whether there is something of a name, also of one that cannot be."""
    try:
        return Path(name).exists()
    except (OSError, ValueError):  # too long, or with a NUL
        return False


def read_text(path: Path | str, most_bytes: int) -> str:
    """Text of a file in UTF-8.

    Raises
    ------
    CpunetError
        If it is no regular file, too large for what it is, or no text.
    OSError
        If it cannot be read.
    """
    file = require_file(path)
    with file.open("rb") as stream:
        content = stream.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise CpunetError(f"{file}: is larger than {most_bytes / 1e6:g} MB; give another file")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise CpunetError(f"{file}: cannot be read (not text)") from error
