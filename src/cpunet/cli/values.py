"""Options that hold several values in one word."""

from __future__ import annotations

import math

from cpunet.errors import CpunetError

_LARGEST = 1e6


def parse_numbers(text: str, n: int, option: str) -> tuple[float, ...]:
    """`n` finite numbers separated by commas.

    Raises
    ------
    CpunetError
        If `text` is anything else; it names the `option`.

    Examples
    --------
    >>> parse_numbers("0,0,-12.5", 3, "--origin")
    (0.0, 0.0, -12.5)
    """
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != n or not all(map(math.isfinite, numbers)):
        raise CpunetError(f"{option} {text[:60]}: expected {n} numbers separated by commas")
    if max(map(abs, numbers), default=0) > _LARGEST:
        raise CpunetError(f"{option} {text[:60]}: at most {_LARGEST:g}")
    return numbers
