"""Environment variables that break other packages, checked before these are imported."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from cpunet.trusted_folders import trusted

MAX_THREADS = 1024
# Turns of the loop in which a thread of OpenMP waits before it sleeps: about 0.1 ms, longer
# than most gaps between two operations and far shorter than others hold a core.
SPIN_COUNT = "3000"

_COUNTS = (
    "OMP_NUM_THREADS",
    "OMP_THREAD_LIMIT",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


def drop_nonsense() -> list[str]:
    """Remove invalid numbers of threads from the environment, and return a line about each.

    numba cannot be imported with them, OpenMP prints warnings of its own, and child processes
    would inherit them.  A folder of compiled code that others can write to is removed as well,
    since that code is run.

    Examples
    --------
    >>> os.environ["NUMBA_NUM_THREADS"] = "0"
    >>> drop_nonsense()
    ["NUMBA_NUM_THREADS='0' is no number of threads (1 to 1024); it is ignored"]
    >>> "NUMBA_NUM_THREADS" in os.environ
    False
    """
    told = []
    for name in _COUNTS:
        value = os.environ.get(name)
        # OpenMP takes a number for each level of nested loops
        parts = (value or "").split(",") if name == "OMP_NUM_THREADS" else [value or ""]
        if value is not None and not all(map(_is_count, parts)):
            del os.environ[name]
            shown = ascii(value if len(value) <= 20 else f"{value[:17]}...")
            told.append(
                f"{name}={shown} is no number of threads (1 to {MAX_THREADS}); it is ignored"
            )
    code = os.environ.get("NUMBA_CACHE_DIR")
    if code and not _is_private(Path(code)):
        del os.environ["NUMBA_CACHE_DIR"]
        told.append(f"NUMBA_CACHE_DIR={code!a} can be written by others; it is ignored")
    return told


def _is_private(folder: Path) -> bool:
    """Whether a folder, or the one in which it would be made, is the user's own."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    return trusted(there) or (there != folder and bool(there.stat().st_mode & stat.S_ISVTX))


def _is_count(text: str) -> bool:
    plain = text.strip()
    return (
        plain.isascii()
        and plain.isdigit()
        and len(plain) < 9
        and 1 <= int(plain) <= MAX_THREADS
    )


def share_the_machine() -> None:
    """Keep OpenMP's threads from spinning for long, before torch loads OpenMP.

    By default threads wait for each other in busy loops. If other programs run as well, the
    thread that the others wait for often has no core, because a waiting one occupies it:
    trainings then take several times as much of the machine. Short loops bridge the gaps
    between two operations; a thread that waits longer sleeps. If the user has set OpenMP's own
    variables, nothing is changed.
    """
    if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
        os.environ["GOMP_SPINCOUNT"] = SPIN_COUNT
