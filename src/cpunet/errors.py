"""The one exception a user should ever see: a single line that says what to do."""

from __future__ import annotations


class CpunetError(Exception):
    """Bad input, named in one line: which file, which event, what to do.

    The command line prints the message and exits with status 2; everything
    else that escapes is a bug and keeps its traceback.
    """
