"""Standard output and standard error, whatever they are.

Characters that the encoding of a terminal lacks cause no failure: common ones are replaced,
others are written by their number.  A log that cannot be written stops no job; a result that
cannot be printed is an error of its own.
"""

from __future__ import annotations

import codecs
import errno
import io
import os
import sys
from contextlib import suppress
from typing import Any

from rich.console import Console

from cpunet.errors import CpunetError

_REPLACING = "cpunet.plain"  # handler of characters that an encoding lacks
_PLAIN_SIGNS = {
    "–": "-", "—": "-", "−": "-", "…": "...", "±": "+-", "×": "x", "µ": "u", "μ": "u",
    "σ": "sigma", "χ": "chi", "→": "->", "≥": ">=", "≤": "<=", "°": "deg", "•": "*",
    "²": "2", "⁰": "0", "¹": "^1", "⁴": "^4",
}  # fmt: skip


class OutputError(CpunetError):
    """A result could not be written to standard output."""


class GoneError(OutputError):
    """The reader of standard output has stopped reading."""


class _Stream(Console):
    """A console that prints names as they are, and leaves errors to this package."""

    def __init__(self, **options: Any) -> None:
        super().__init__(emoji=False, **options)  # in FILE:key:, a picture would replace key

    def on_broken_pipe(self) -> None:
        """Pass the error on; rich would end the program."""
        raise


class Results(_Stream):
    """Standard output, which a result must reach."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print, or raise an `OutputError`."""
        try:
            super().print(*objects, **options)
        except BrokenPipeError as error:
            raise GoneError("standard output: its reader has stopped reading") from error
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"standard output: cannot be written ({reason})") from error


class Notes(_Stream):
    """Standard error: a message that cannot be printed is lost, but stops nothing."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print if possible."""
        with suppress(OSError):
            super().print(*objects, **options)


class _Closed(io.TextIOBase):
    """Stands in for a standard output that was closed before the program began."""

    def write(self, _text: str, /) -> int:
        raise OSError(errno.EBADF, "it is closed")


def prepare_streams() -> None:
    """Make the standard streams accept every character, and open those that were closed.

    The next file would take the number of a closed one, and what is printed would go into it.
    """
    for number in range(3):
        with suppress(OSError):  # open: as it should be
            os.fstat(number)
            continue
        os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    if sys.stdout is None:
        sys.stdout = _Closed()
    codecs.register_error(_REPLACING, _replaced)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_REPLACING)


def finish_streams() -> None:
    """Flush the streams now, so that nothing fails when the interpreter does so at its end."""
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            with suppress(OSError, ValueError):
                sink = os.open(os.devnull, os.O_WRONLY)
                os.dup2(sink, stream.fileno())
                os.close(sink)


def _replaced(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    signs = error.object[error.start : error.end]
    plain = "".join(_PLAIN_SIGNS.get(sign) or ascii(sign)[1:-1] for sign in signs)
    return plain, error.end
