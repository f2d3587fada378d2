"""How far long work is: a bar where someone looks on, else a line of the log now and then."""

from __future__ import annotations

import io
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm.auto import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

log = logging.getLogger(__name__)

LOG_EVERY_S = 30.0  # between lines of a log


class Stage(tqdm):  # type: ignore[misc]
    """A bar that no thread draws."""

    monitor_interval = 0


class _Logged(Stage):
    """The same as lines of the log."""

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        if msg is None:  # else the bar is cleared
            left = "/{total}, {rate_noinv_fmt}, {remaining} left"
            ends = self.total and self.n < self.total
            form = "{desc}: {n}" + (left if ends else ", {rate_noinv_fmt}") + "{postfix}"
            log.info(self.format_meter(**{**self.format_dict, "bar_format": form}))


@contextmanager
def stage(title: str, total: int | None = None) -> Iterator[Stage]:
    """Show how far the work within is: by a bar on a terminal or in a notebook.

    Elsewhere the log has it at level INFO, every `LOG_EVERY_S` seconds and at the end.  A level
    of the logger ``cpunet`` above WARNING silences bars, too.

    Parameters
    ----------
    title
        What is done.
    total
        Number of items; None if it is unknown.

    Yields
    ------
    Stage
        To be updated with the number of items done since the last update.
    """
    if sys.stderr.isatty() or "ipykernel" in sys.modules:
        own = logging.getLogger("cpunet")
        speaking = [own] if own.handlers else None  # else the root, which writes above the bar
        silent = not log.isEnabledFor(logging.WARNING)
        how = {"leave": None, "miniters": 1, "unit": "", "dynamic_ncols": True}
        bar = Stage(None, title, total, disable=silent, **how)
        with bar, logging_redirect_tqdm(speaking):
            yield bar
        return
    often = {"miniters": 1, "mininterval": LOG_EVERY_S, "delay": LOG_EVERY_S}
    with _Logged(None, title, total, leave=False, file=io.StringIO(), unit="", **often) as bar:
        start = time.monotonic()
        yield bar
    log.info("%s: done in %.1f s", title, time.monotonic() - start)
