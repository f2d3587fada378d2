"""Progress of a call: bars in a notebook or on a terminal, and log records elsewhere."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from cpunet.analysis.html_pages import part
from cpunet.jobs.common.monitor import Advance, Monitor

LOGGER = logging.getLogger("cpunet")
WARNING = "warning: "  # start of a note that is a warning
REDRAWN_S = 0.2  # between two updates of a bar


class LoggingMonitor(Monitor):
    """Notes as records of the logger ``cpunet``; no bars."""

    def note(self, message: str) -> None:
        """Log a warning at level WARNING, any other note at level INFO."""
        if message.startswith(WARNING):
            LOGGER.warning(message.removeprefix(WARNING))
        else:
            LOGGER.info(message)


class TerminalMonitor(LoggingMonitor):
    """A bar for each stage on standard error."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Show a bar while the stage lasts."""
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=self._console) as progress:
            task = progress.add_task(title, total=total)
            yield lambda steps: progress.advance(task, steps)


@dataclass
class Bar:
    """A stage as a notebook shows it."""

    title: str
    total: int | None
    done: int = 0
    seconds: float = 0.0
    ended: bool = False

    def __repr__(self) -> str:
        of = "" if self.total is None else f" of {self.total}"
        count = f" {self.done}{of}" if self.done or of else ""
        return f"{self.title}:{count} in {self.seconds:.0f} s"

    def _repr_html_(self) -> str:
        total = 1 if self.ended else self.total
        done = total if self.ended or total is None else min(self.done, total)
        return part("progress", total, done, repr(self))


@dataclass(frozen=True)
class Line:
    """A note as a notebook shows it."""

    text: str

    def __repr__(self) -> str:
        return self.text

    def _repr_html_(self) -> str:
        return part("line", self.text)


class NotebookMonitor(Monitor):
    """Bars and notes in the output of a notebook's cell; needs no widgets.

    Parameters
    ----------
    display
        ``IPython.display.display``, or a substitute.
    """

    def __init__(self, display: Callable[..., Any]) -> None:
        self._display = display

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Show a bar, which stays after the stage."""
        bar, start = Bar(title, total), time.monotonic()
        handle, drawn = self._display(bar, display_id=True), start

        def advance(steps: int) -> None:
            nonlocal drawn
            bar.done += steps
            now = time.monotonic()
            if now - drawn >= REDRAWN_S:
                bar.seconds, drawn = now - start, now
                handle.update(bar)

        try:
            yield advance
            bar.ended = True
        finally:
            bar.seconds = time.monotonic() - start
            handle.update(bar)

    def note(self, message: str) -> None:
        """Show a line."""
        self._display(Line(message))


class NotesKept(Monitor):
    """Pass stages and notes on to another monitor, and keep the notes."""

    def __init__(self, passed_to: Monitor) -> None:
        self._passed_to = passed_to
        self.notes: list[str] = []

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Enter a stage."""
        with self._passed_to.stage(title, total) as advance:
            yield advance

    def state(self, text: str) -> None:
        """Pass on the text beside the progress."""
        self._passed_to.state(text)

    def note(self, message: str) -> None:
        """Keep a note, and pass it on."""
        self.notes.append(message)
        self._passed_to.note(message)


def shown(progress: bool | Monitor) -> NotesKept:
    """Return the monitor that shows the progress of a call and keeps its notes.

    Parameters
    ----------
    progress
        True for bars in a notebook or on a terminal; False for log records only; or
        a monitor to use instead.
    """
    if isinstance(progress, Monitor):
        return NotesKept(progress)
    if progress and (display := notebook_display()) is not None:
        return NotesKept(NotebookMonitor(display))
    if progress and sys.stderr.isatty():
        return NotesKept(TerminalMonitor())
    return NotesKept(LoggingMonitor())


def notebook_display() -> Callable[..., Any] | None:
    """``IPython.display.display`` if this is a notebook, else None."""
    ipython: Any = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if shell is None or not hasattr(shell, "kernel"):
        return None
    display: Callable[..., Any] = ipython.display.display
    return display
