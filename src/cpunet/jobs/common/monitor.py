"""How a long job tells what it is doing; the command line draws bars from it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Advance = Callable[[int], None]


class Monitor:
    """Told of each stage of a job and of its progress; this one keeps quiet."""

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Enter a stage of `total` steps (None if not known); call what it gives with steps."""
        yield lambda _steps: None

    def state(self, text: str) -> None:
        """Take what is to be shown beside the progress of the stage, until there is news."""

    def note(self, message: str) -> None:
        """Take a line of information for the user."""
