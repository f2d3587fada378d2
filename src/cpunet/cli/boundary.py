"""Whatever ends a command becomes one line on standard error and an exit status.

Status 2 is for what the user can mend, 1 for what nobody thought of, 128 and more for a signal.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from types import FrameType

import typer

from cpunet.cli.messages import fail
from cpunet.errors import CpunetError
from cpunet.installation import DISTRIBUTION

USAGE, BUG = 2, 1

# typer brings click's exceptions in its own package or as click's; this is their base
_ClickError = typer.BadParameter.__mro__[2]
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NO_MEMORY = ("allocate memory", "out of memory", "unable to allocate")


def ended_with(error: BaseException, words: Sequence[str], *, debug: bool) -> int:
    """Say in one line what a command of these words ended with; return the exit status."""
    text = " ".join(str(error).split())
    if isinstance(error, KeyboardInterrupt | SystemExit | typer.Abort):
        status = error.code if isinstance(error, SystemExit) else 128 + signal.SIGINT
        if status in (128 + signal.SIGINT, 128 + signal.SIGTERM):
            fail("interrupted; nothing half-written was left")
        return status if isinstance(status, int) else BUG
    if isinstance(error, BrokenPipeError):  # nobody reads on, as in "cpunet … | head"
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BUG
    if debug:
        traceback.print_exception(error)
    if isinstance(error, _ClickError):
        return _wrong_usage(error)
    files = ", ".join(word for word in words if os.path.exists(word))  # noqa: PTH110
    about = f"{files}: " if files else ""
    if isinstance(error, CpunetError):
        fail(text)
    elif isinstance(error, MemoryError) or any(part in text.lower() for part in _NO_MEMORY):
        fail(f"{about}out of memory ({text[:200]}); take fewer pulses, or smaller batches")
    elif isinstance(error, OSError) and error.errno:
        remedy = "make room" if error.errno in _FULL else "check its name and permissions"
        about = f"{error.filename}: "[-200:] if error.filename else about
        fail(f"{about}{os.strerror(error.errno)}; {remedy}, or choose another place")
    else:
        fail(
            f"{about}unexpected {type(error).__name__} ({text[:200]}); please report it to the "
            f"makers of {DISTRIBUTION}, with what --debug prints"
        )
        return BUG
    return USAGE


def _wrong_usage(error: BaseException) -> int:
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":  # a command alone asks for its help
        getattr(error, "show")()  # noqa: B009
        return USAGE
    told = str(getattr(error, "format_message", error.__str__)())
    path = "cpunet" if context is None else str(context.command_path)
    fail(f"{' '.join(told.split()).rstrip('.')}; see {path} --help")
    return USAGE


def stop(number: int, _frame: FrameType | None) -> None:
    """Leave as on an error, so that Ctrl-C and batch systems leave nothing half-written."""
    sys.exit(128 + number)
