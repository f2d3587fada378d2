"""The only exception that users see: one line that says what to do."""

from __future__ import annotations


class CpunetError(Exception):
    """Bad input, described in one line: which file, which event, what to do.

    The command line prints the message and exits with status 2.
    """
