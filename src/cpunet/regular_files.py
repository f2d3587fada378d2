"""Require regular files as inputs: a named pipe would block, a device never end."""

from __future__ import annotations

import stat
from pathlib import Path

from cpunet.errors import CpunetError


def require_file(path: Path | str) -> Path:
    """Return the path, unless it is neither a file nor a folder.

    Missing or inaccessible paths are left to the code that opens them.

    Raises
    ------
    CpunetError
        If the path is a pipe, a socket or a device.
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
    """Whether a path exists; False for impossible names."""
    try:
        return Path(name).exists()
    except (OSError, ValueError):  # too long, or with a NUL
        return False


def read_text(path: Path | str, most_bytes: int) -> str:
    """Text of a UTF-8 file.

    Raises
    ------
    CpunetError
        If the path is not a regular file, is larger than `most_bytes`, or is not text.
    OSError
        If the file cannot be read.
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
