"""Available memory, and an error message instead of a killed process.

Linux grants more memory than exists, and kills processes that use it.  Code that needs much
memory therefore checks first.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

from cpunet.errors import CpunetError

_INFO = Path("/proc/meminfo")
_STATUS = Path("/proc/self/statm")
# Containers and batch jobs limit the memory of a control group; the names of the files of its
# limit and its use differ in the two versions of such groups.
_OWN_GROUPS = Path("/proc/self/cgroup")
_GROUPS = Path("/sys/fs/cgroup")
_NAMES_2 = ("memory.max", "memory.current")
_NAMES_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes")


def available_bytes() -> int | None:
    """Memory still available, limited by the machine, the container and the process.

    Returns
    -------
    int or None
        The smallest of the limits; None if the system reports none, as on macOS.
    """
    known = [_of_machine(), *(_of_group(*files) for files in _groups()), _of_process()]
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


def _groups() -> Iterator[tuple[Path, Path]]:
    """Files of limit and use of the groups that this process may be in."""
    try:
        lines = _OWN_GROUPS.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, inner = line.split(":", 2)
        if not controllers:
            root, names = _GROUPS, _NAMES_2
        elif "memory" in controllers.split(","):
            root, names = _GROUPS / "memory", _NAMES_1
        else:
            continue
        # a batch job's limit is that of a group further out; in a container only the outermost
        # group is visible
        for place in (Path(inner), *Path(inner).parents):
            folder = root / place.relative_to("/")
            yield folder / names[0], folder / names[1]


def _of_group(limit: Path, used: Path) -> int | None:
    try:
        left = int(limit.read_text()) - int(used.read_text())
    except (OSError, ValueError):  # no group, or "max": no limit but that of the machine
        return None
    return max(left + _cached_files(used.with_name("memory.stat")), 0)


def _cached_files(stat: Path) -> int:
    """Memory of a group that holds contents of files; the system frees it when it is needed."""
    try:
        counts = dict(line.split() for line in stat.read_text().splitlines())
        # in version 1, only the totals include the groups within the group
        return sum(
            int(counts.get(f"total_{name}", counts.get(name, 0)))
            for name in ("active_file", "inactive_file")
        )
    except (OSError, ValueError):
        return 0


def _of_process() -> int | None:
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return None
    try:
        pages = int(_STATUS.read_text().split()[0])
    except (OSError, ValueError):
        return None
    return max(limit - pages * resource.getpagesize(), 0)
