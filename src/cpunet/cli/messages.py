"""Messages and progress bars on stderr; results go to stdout."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from cpunet.jobs.monitor import Advance, Monitor

out = Console()
err = Console(stderr=True)


def fail(message: str) -> None:
    """Print an error as one line."""
    err.print(f"[bold red]error:[/] {_plain(message)}", soft_wrap=True, highlight=False)


def _plain(text: str) -> str:
    # file names may hold brackets, which rich would read as markup
    return " ".join(text.split()).replace("[", r"\[")


class BarMonitor(Monitor):
    """A bar per stage with count, rate, and elapsed and remaining time."""

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Show a bar while the stage lasts."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=err) as progress:
            task = progress.add_task(_plain(title), total=total, rate="")

            def advance(steps: int) -> None:
                progress.advance(task, steps)
                speed = progress.tasks[0].finished_speed or progress.tasks[0].speed
                progress.update(task, rate=f"{speed:.3g}/s" if speed else "")

            yield advance

    def note(self, message: str) -> None:
        """Print a line."""
        err.print(_plain(message), soft_wrap=True, highlight=False)
