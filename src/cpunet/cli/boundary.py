"""Turn whatever ended a command into one line and an exit status.

Status 2 is for what the user can mend: bad input, a full disk, too little memory.  70 is for
what nobody thought of, a bug; 128 and more for a signal.
"""

from __future__ import annotations

import errno
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import typer

import cpunet
from cpunet.cli.messages import fail
from cpunet.cli.streams import GoneError
from cpunet.errors import CpunetError
from cpunet.installation import DISTRIBUTION

USAGE, BUG = 2, 70
_READER_GONE = 128 + signal.SIGPIPE

# typer brings click's exceptions in its own package or as click's; both derive from these
_UsageError, _ClickError = typer.BadParameter.__mro__[1:3]

_ADVICE = {
    errno.ENOSPC: "make room, or write elsewhere",
    errno.EDQUOT: "make room, or write elsewhere",
    errno.EFBIG: "write to a file system that takes larger files",
    errno.EACCES: "ask its owner for permission, or choose another place",
    errno.EPERM: "ask its owner for permission, or choose another place",
    errno.EROFS: "choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOENT: "check the name",
    errno.ELOOP: "remove the link",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.EIO: "check the disk or the network, and try again",
    errno.ESTALE: "check the network, and try again",
}
_NO_MEMORY = ("can't allocate memory", "out of memory", "cannot allocate memory")


def ended_with(error: BaseException, *, debug: bool) -> int:
    """Say in one line what a command ended with; return the status to exit with.

    Parameters
    ----------
    error
        What it raised.
    debug
        Print its traceback first.
    """
    if isinstance(error, SystemExit):  # said already
        return error.code if isinstance(error.code, int) else BUG if error.code else 0
    if debug:
        traceback.print_exception(error)
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        fail("interrupted; nothing half-written was left")
        return 128 + signal.SIGINT
    if isinstance(error, _ClickError):
        return _wrong_usage(error)
    if isinstance(error, GoneError | BrokenPipeError):
        fail(str(error) if isinstance(error, GoneError) else "whoever read this has stopped")
        return _READER_GONE
    line = _known(error)
    fail(_unknown(error) if line is None else line)
    return BUG if line is None else USAGE


def _wrong_usage(error: BaseException) -> int:
    told = str(getattr(error, "format_message", error.__str__)())
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":  # a command alone asks for its help
        print_help = getattr(error, "show", None)
        if print_help is not None:
            print_help()
        return USAGE
    path = "cpunet" if context is None else str(context.command_path)
    fail(f"{' '.join(told.split()).rstrip('.')}; see {path} --help")
    return USAGE


def _known(error: BaseException) -> str | None:
    """What the system refused, or what was wrong with the input; None for anything else."""
    if isinstance(error, CpunetError):
        return str(error)
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError) or any(word in text.lower() for word in _NO_MEMORY):
        where = _prefix(error)
        return f"{where}out of memory ({text or 'no more could be had'}); take less at a time"
    if isinstance(error, UnicodeEncodeError) and _is_surrogate(error):
        name = ascii(error.object)[1:61]
        return f"{name}: a name that is no UTF-8 text; rename the file"
    if isinstance(error, RuntimeError) and text.startswith("Symlink loop"):
        return f"{text}; remove the link"  # as Python before 3.13 says ELOOP
    if (damaged := _damaged_code(error)) is not None:
        return f"{damaged}: damaged compiled code; remove it and try again"
    if isinstance(error, OSError) and error.errno is not None:
        name = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else ""
        place = f"{_short(name)}: " if name else _prefix(error)
        advice = _ADVICE.get(error.errno, "check it, and try again")
        return f"{place}{error.strerror or os.strerror(error.errno)}; {advice}"
    return None


def _unknown(error: BaseException) -> str:
    text = " ".join(str(error).split())
    kind = type(error).__name__
    said = f"{kind}: {text[:200]}" if text else kind
    return (
        f"{_prefix(error)}cpunet {cpunet.__version__} failed unexpectedly ({said}); this is a "
        f"bug, please report it to the makers of {DISTRIBUTION} with what --debug prints"
    )


def _prefix(error: BaseException) -> str:
    """The file that was being read or written, from the innermost of our functions."""
    for frame in _ours(error):
        for holder in (frame.f_locals, getattr(frame.f_locals.get("self"), "__dict__", {})):
            for name in ("path", "_path", "file", "source", "run", "target", "out", "folder"):
                if isinstance(found := holder.get(name), Path):
                    return f"{_short(str(found))}: "
    return ""


def _ours(error: BaseException) -> Iterator[FrameType]:
    """Frames of this package, the innermost first."""
    home = str(Path(cpunet.__file__).parent)
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    yield from (f for f in reversed(frames) if f.f_code.co_filename.startswith(home))


def _damaged_code(error: BaseException) -> str | None:
    """The file of compiled code that numba could not read, of this package or another."""
    kinds = pickle.UnpicklingError | EOFError | ValueError | TypeError
    if not (isinstance(error, kinds) or "unpickl" in str(error).lower()):
        return None
    for frame, _ in traceback.walk_tb(error.__traceback__):
        if frame.f_code.co_name in ("_load_index", "_load_data"):
            holder = frame.f_locals.get("self")
            found = frame.f_locals.get("path") or getattr(holder, "_index_path", None)
            if isinstance(found, str):
                return found
    return None


def _is_surrogate(error: UnicodeEncodeError) -> bool:
    return any("\ud800" <= sign <= "\udfff" for sign in error.object[error.start : error.end])


def _short(name: str) -> str:
    return name if len(name) <= 200 else f"{name[:80]}…{name[-40:]}"


def report_interrupt(number: int, _frame: FrameType | None) -> None:
    """Leave as on an error, so that Ctrl-C and batch systems leave nothing half-written."""
    fail("interrupted; nothing half-written was left")
    sys.exit(128 + number)
