"""Messages and progress on stderr; results go to stdout."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.table import Table
from rich.text import Text

# in FILE:key:, a picture would replace key
out, err = Console(emoji=False), Console(emoji=False, stderr=True)


def tell(result: str | Table) -> None:
    """Print a line as it is (brackets are no markup), or a table with every number whole."""
    if isinstance(result, Table):
        _print_table(result)
    else:
        out.print(result, markup=False, highlight=False, soft_wrap=True)


def fail(message: str) -> None:
    """Print an error as one line."""
    err.print(Text.assemble(("error:", "bold red"), " ", _one_line(message)), soft_wrap=True)


class _Lines(logging.Formatter):
    """One line for each record, which begins with its level if that is a warning or more."""

    def __init__(self, worded: Callable[[str], str]) -> None:
        super().__init__()
        self.worded = worded

    def format(self, record: logging.LogRecord) -> str:
        line = self.worded(_one_line(super().format(record)))
        if record.levelno < logging.WARNING:
            return line
        level = f"{record.levelname.lower()}:"
        return f"\033[1m{level}\033[0m {line}" if err.is_terminal else f"{level} {line}"


@contextmanager
def messages_to_stderr(worded: Callable[[str], str] = str) -> Iterator[None]:
    """Print records of this package within the context, from level INFO up, as `worded`."""
    logger, handler = logging.getLogger("cpunet"), logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Lines(worded))
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)


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


def _one_line(text: str) -> str:
    return " ".join(text.split())
