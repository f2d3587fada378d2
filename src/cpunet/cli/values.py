"""Options of ``cpunet simulate`` that hold several values in one word."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from cpunet.errors import CpunetError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cpunet.jobs.simulation.hit_sources import Window
    from cpunet.jobs.simulation.simulate import Resolution
    from cpunet.recipes.schema import PeakConfig


MAX_EVENTS = 1_000_000_000  # of a window; simulate more in several files
_LARGEST = 1e6


def parse_events(
    events: str, peak: str | None, peaks: Mapping[str, PeakConfig], window_kev: float
) -> tuple[list[Window], tuple[int, ...]]:
    """Windows and the events wanted in each, of ``"1000"`` or ``"FEP=1000,DEP=300"``.

    Parameters
    ----------
    events, peak
        The words given; without names in `events`, `peak` names them (default: all).
    peaks
        The lines known.
    window_kev
        Half-width about a line.

    Raises
    ------
    CpunetError
        If a number or a line cannot be understood, a line is named twice, or the lines are
        named in both.
    """
    from cpunet.jobs.simulation.hit_sources import energy_windows

    if "=" not in events:
        windows = energy_windows(peak or ",".join(peaks), peaks, window_kev)
        if len(set(windows)) < len(windows):
            raise CpunetError(f"--peak {peak}: names a peak twice; give each once")
        return windows, (event_count(events),) * len(windows)
    if peak is not None:
        raise CpunetError(f"--events {events} names its peaks; leave out --peak")
    names, numbers = wanted_events(events)
    return energy_windows(",".join(names), peaks, window_kev), numbers


def wanted_events(events: str) -> tuple[list[str], tuple[int, ...]]:
    """Names and numbers of ``"FEP=4000,DEP=1500"``.

    Raises
    ------
    CpunetError
        If it has another form, or a name occurs twice.
    """
    pairs = [part.partition("=") for part in events.split(",")]
    for name, _, number in pairs:
        if not (name.strip() and number.strip().isdecimal()):
            raise CpunetError(f"--events {events}: expected FEP=N,DEP=M and the like")
    names = [name.strip() for name, _, _ in pairs]
    if len(set(names)) < len(names):
        raise CpunetError(f"--events {events}: names a peak twice; give each once")
    return names, tuple(event_count(number) for _, _, number in pairs)


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


def parse_resolution(text: str | None) -> Resolution | None:
    """The resolution of ``"0.5,0.0018"``; None if not given.

    Raises
    ------
    CpunetError
        If there are not two numbers from 0 up.
    """
    from cpunet.jobs.simulation.simulate import Resolution

    if text is None:
        return None
    noise, fano = parse_numbers(text, 2, "--resolution")
    return Resolution(noise, fano)


def event_count(text: str) -> int:
    """A number of events.

    Raises
    ------
    CpunetError
        If `text` is none, or there are too many.
    """
    # underscores and signs, which int() takes, are more likely slips
    digits = text.strip().lstrip("0") or "0"
    if not text.strip().isdecimal():
        raise CpunetError(
            f"--events: {text[:60]!r} is no number of events; give N or FEP=N,DEP=M"
        )
    if len(digits) > len(str(MAX_EVENTS)) or int(digits) > MAX_EVENTS:
        raise CpunetError(f"--events: {text[:60]!r} are too many; at most {MAX_EVENTS}")
    return int(digits)
