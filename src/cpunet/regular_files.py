"""Read text files that the user names."""

from __future__ import annotations

from pathlib import Path

from cpunet.errors import CpunetError


def read_text(path: Path | str, most_bytes: int) -> str:
    """Text of a UTF-8 file.

    Raises
    ------
    CpunetError
        If the file is larger than `most_bytes`, or is not text.
    OSError
        If the file cannot be read.
    """
    with Path(path).open("rb") as stream:
        content = stream.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise CpunetError(f"{path}: is larger than {most_bytes / 1e6:g} MB; give another file")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise CpunetError(f"{path}: cannot be read (not text)") from error
