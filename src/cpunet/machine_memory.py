"""How much memory a job can still have, and a line instead of a killed process.

Linux lends more than there is, and kills whoever uses it.  So what needs much asks first.
"""

from __future__ import annotations

import resource
from pathlib import Path

from cpunet.errors import CpunetError

_INFO = Path("/proc/meminfo")
_STATUS = Path("/proc/self/statm")
# of a container or a batch job: what it may have, and what it has (cgroups of both versions)
_GROUPS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (
        Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
        Path("/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ),
)


def available_bytes() -> int | None:
    """Memory that can still be had: of the machine, the container and the process.

    Returns
    -------
    int or None
        The smallest of these; None where the system does not tell, as on macOS.
    """
    known = [_of_machine(), *(_of_group(*files) for files in _GROUPS), _of_process()]
    return min((n for n in known if n is not None), default=None)


def require_memory(n_bytes: float, what: str, advice: str) -> None:
    """Raise a `CpunetError` if something needs more memory than there is.

    Parameters
    ----------
    n_bytes
        Memory needed.
    what
        What needs it, with the file: the beginning of the message.
    advice
        How to need less.
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
    except (OSError, ValueError):  # none, or "max": as much as the machine has
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
