"""The only exception that users see: one line that says what to do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class CpunetError(Exception):
    """Bad input, described in one line: which file, which event, what to do.

    The command line prints the message and exits with status 2.

    Parameters
    ----------
    text
        What is wrong.
    remedy
        What to do, which ends the message; empty if the text says it.
    """

    def __init__(self, text: str, remedy: str = "") -> None:
        super().__init__(text, remedy)
        self.text, self.remedy = text, remedy

    def __str__(self) -> str:
        return f"{self.text}; {self.remedy}" if self.remedy else self.text


def named(values: Mapping[str, Any], name: str, kind: str) -> Any:
    """A value by name.

    Raises
    ------
    CpunetError
        If there is no such value; the message lists the names.
    """
    if name not in values:
        raise CpunetError(f"no {kind} {name!r}; there are {', '.join(values)}")
    return values[name]
