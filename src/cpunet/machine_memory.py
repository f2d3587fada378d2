"""Available memory, and an error message instead of a killed process.

Linux grants more memory than exists, and kills processes that use it.  Code that needs much
memory therefore checks first.
"""

from __future__ import annotations

import resource
from pathlib import Path

from cpunet.errors import CpunetError

_INFO = Path("/proc/meminfo")
_STATUS = Path("/proc/self/statm")
# Limit and use of a container or a batch job, for both versions of cgroups.
_GROUPS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (
        Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
        Path("/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ),
)


def available_bytes() -> int | None:
    """Memory still available, limited by the machine, the container and the process.

    Returns
    -------
    int or None
        The smallest of the limits; None if the system reports none, as on macOS.
    """
    known = [_of_machine(), *(_of_group(*files) for files in _GROUPS), _of_process()]
    return min((n for n in known if n is not None), default=None)


def require_memory(n_bytes: float, what: str, advice: str) -> None:
    """Raise a `CpunetError` if more memory is needed than is available.

    Parameters
    ----------
    n_bytes
        Memory needed.
    what
        What needs the memory, with the file; start of the message.
    advice
        How to need less; end of the message.
    """
    there = available_bytes()
    if there is not None and n_bytes > there:
        raise CpunetError(
            f"{what}: about {n_bytes / 1e9:.2g} GB of memory are needed, {there / 1e9:.2g} GB "
            f"are free; {advice}"
        )


def _of_machine() -> int | None:
    try:
        lines = _INFO.read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        name, _, value = line.partition(":")
        if name == "MemAvailable":
            return int(value.split()[0]) * 1024
    return None


def _of_group(limit: Path, used: Path) -> int | None:
    try:
        return max(int(limit.read_text()) - int(used.read_text()), 0)
    except (OSError, ValueError):  # no group, or "max": no limit but that of the machine
        return None


def _of_process() -> int | None:
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return None
    try:
        pages = int(_STATUS.read_text().split()[0])
    except (OSError, ValueError):
        return None
    return max(limit - pages * resource.getpagesize(), 0)
