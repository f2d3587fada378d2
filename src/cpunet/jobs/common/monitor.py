"""Progress reports of long jobs, which the command line shows as progress bars."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Advance = Callable[[int], None]


class Monitor:
    """Receiver of the stages and the progress of a job; this base class is silent."""

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Enter a stage of `total` steps (None if unknown); yield a function to count them."""
        yield lambda _steps: None

    def state(self, text: str) -> None:
        """Set the text beside the progress of the stage."""

    def note(self, message: str) -> None:
        """Give the user a line of information."""


class Relay(Monitor):
    """Pass steps and notes on to given functions, such as those of a parent process.

    Parameters
    ----------
    advance, note
        Receivers of the steps of all stages, and of the notes.
    """

    def __init__(self, advance: Advance, note: Callable[[str], None]) -> None:
        self._advance, self._note = advance, note

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Pass on the steps of a stage."""
        del title, total
        yield self._advance

    def note(self, message: str) -> None:
        """Pass on a note."""
        self._note(message)
