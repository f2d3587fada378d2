"""Messages and progress on stderr; results go to stdout."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
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
from rich.table import Table
from rich.text import Text

from cpunet.jobs.common.monitor import Advance, Monitor

# in FILE:key:, a picture would replace key
out, err = Console(emoji=False), Console(emoji=False, stderr=True)

LOG_EVERY_S = 30.0  # between lines of progress in a log file


def tell(result: str | Table) -> None:
    """Print a line as it is (brackets are no markup), or a table with every number whole."""
    if isinstance(result, Table):
        _print_table(result)
    else:
        out.print(result, markup=False, highlight=False, soft_wrap=True)


def fail(message: str) -> None:
    """Print an error as one line."""
    err.print(Text.assemble(("error:", "bold red"), " ", _one_line(message)), soft_wrap=True)


def warn(message: str) -> None:
    """Print a warning as one line."""
    err.print(Text.assemble(("warning:", "bold"), " ", _one_line(message)), soft_wrap=True)


def note(message: str) -> None:
    """Print one line on stderr."""
    err.print(_one_line(message), markup=False, highlight=False, soft_wrap=True)


def _print_table(table: Table) -> None:
    """Print a table with every number whole, on a narrow screen or in a log, too.

    Words and headings are broken if that makes the table fit; else it is wider than the screen.
    """
    _, right, _, left = table.padding
    room = out.width - 1 - len(table.columns) * (left + right + 1)
    least, most = [], []
    for column in table.columns:
        head = Text.from_markup(str(column.header), emoji=False).plain
        cells = [Text.from_markup(str(cell), emoji=False).plain for cell in column.cells]
        most.append(max([1, *map(len, (head, *cells))]))
        if column.justify != "right":  # words
            cells = [word for cell in cells for word in cell.split()]
        least.append(max([1, *map(len, cells)]))
    spare = room - sum(least)
    for column, low, high in zip(table.columns, least, most, strict=True):
        more = high - low if spare < 0 else min(spare, high - low)
        column.width, column.no_wrap, column.overflow = low + more, False, "fold"
        spare -= 0 if spare < 0 else more
    whole = out.width - room + sum(column.width or 0 for column in table.columns)
    Console(emoji=False, file=out.file, width=max(out.width, whole)).print(table)


def monitor() -> Monitor:
    """Progress bars on a terminal, now and then a line in a batch job's log."""
    return BarMonitor() if err.is_terminal else LogMonitor()


class BarMonitor(Monitor):
    """A bar per stage with count, rate, and elapsed and remaining time."""

    def __init__(self) -> None:
        self._show: Callable[[str], None] = lambda _text: None

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Show a bar while the stage lasts."""
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TextColumn("{task.fields[state]}", markup=False),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=err) as progress:
            task = progress.add_task(title, total=total, rate="", state="")
            self._show = lambda text: progress.update(task, state=text)
            start, done = time.monotonic(), 0

            def advance(steps: int) -> None:
                nonlocal done
                done += steps
                rate = f"{done / (time.monotonic() - start):.3g}/s"
                most = None if total is None else max(done, total)
                progress.update(task, advance=steps, rate=rate, total=most)

            yield advance
            if total is not None:
                progress.update(task, completed=max(done, total))

    def state(self, text: str) -> None:
        """Show a text beside the bar."""
        self._show(text)

    def note(self, message: str) -> None:
        """Print a line."""
        note(message)


class LogMonitor(Monitor):
    """A line at the end of each stage, and every `LOG_EVERY_S` seconds in a long one."""

    def __init__(self) -> None:
        self._state = ""

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Print lines while the stage lasts."""
        start = last = time.monotonic()
        done = 0

        def advance(steps: int) -> None:
            nonlocal done, last
            done += steps
            now = time.monotonic()
            if now - last >= LOG_EVERY_S:
                last = now
                rate = done / (now - start)
                left = (
                    f", {(total - done) / rate:.0f} s left"
                    if total and 0 < done < total
                    else ""
                )
                state = f", {self._state}" if self._state else ""
                note(f"{title}: {done}/{total or '?'}, {rate:.3g}/s{left}{state}")

        self._state = ""
        yield advance
        note(f"{title}: done in {time.monotonic() - start:.1f} s")

    def state(self, text: str) -> None:
        """Keep a text for the next line."""
        self._state = text

    def note(self, message: str) -> None:
        """Print a line."""
        note(message)


def _one_line(text: str) -> str:
    return " ".join(text.split())
