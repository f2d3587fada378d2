"""Windows of deposited energy, and how many events are wanted in each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from cpunet.errors import CpunetError
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import PeakConfig

MAX_EVENTS = 1_000_000_000  # of a window; simulate more in several files


class Window(NamedTuple):
    """Energies (keV) from `low_kev` to `high_kev`, both included, under a name."""

    name: str
    low_kev: float
    high_kev: float


def energy_windows(
    text: str, peaks: Mapping[str, PeakConfig], half_width_kev: float
) -> list[Window]:
    """Windows from ``"FEP,DEP"`` or ranges in keV such as ``"1500-1580"``.

    Parameters
    ----------
    text
        Names and ranges, separated by commas.
    peaks
        Known gamma lines.
    half_width_kev
        Half-width of the windows around the lines.

    Raises
    ------
    CpunetError
        If a part is neither a known line nor a range, or the half-width is not above 0.

    Examples
    --------
    >>> lines = {"FEP": PeakConfig(energy_kev=2614.5, half_width_kev=5)}
    >>> [tuple(window) for window in energy_windows("FEP,1500-1580", lines, 0.5)]
    [('FEP', 2614.0, 2615.0), ('1500-1580', 1500.0, 1580.0)]
    """
    if not half_width_kev > 0:
        raise CpunetError(f"window_kev {half_width_kev}: give a half-width above 0")
    windows = []
    for name in (part.strip() for part in text.split(",")):
        chosen = parse_selection(name, peaks)
        if chosen.chosen:
            line = peaks[name].energy_kev
            windows.append(Window(name, line - half_width_kev, line + half_width_kev))
        else:
            windows.append(Window(name, *chosen.ranges_kev[0]))
    return windows


def wanted_events(
    events: str | Mapping[str, int], peaks: Mapping[str, PeakConfig], half_width_kev: float
) -> dict[Window, int]:
    """Windows and the events wanted in each.

    Parameters
    ----------
    events
        ``"FEP=4000,1500-1580=300"``, the same as a mapping, or a number for each of `peaks`.
    peaks, half_width_kev
        See `energy_windows`.

    Raises
    ------
    CpunetError
        If a number or a line cannot be understood, or a line is named twice.

    Examples
    --------
    >>> lines = {"FEP": PeakConfig(energy_kev=2614.5, half_width_kev=5)}
    >>> list(wanted_events("FEP=10,1500-1580=5", lines, 0.5).values())
    [10, 5]
    """
    if isinstance(events, str):
        pairs = [part.partition("=")[::2] for part in events.split(",")]
        if "=" not in events:
            pairs = [(name, events) for name in peaks]
    else:
        pairs = [(name, str(number)) for name, number in events.items()]
    names = [name.strip() for name, _ in pairs]
    if len(set(names)) < len(names):
        raise CpunetError(f"`events` {events}: names a peak twice; give each once")
    windows = energy_windows(",".join(names), peaks, half_width_kev)
    return dict(zip(windows, (_count(number) for _, number in pairs), strict=True))


def _count(text: str) -> int:
    # underscores and signs, which int() takes, are more likely slips
    if not text.strip().isdecimal():
        raise CpunetError(
            f"`events`: {text[:60]!r} is no number of events; give N or FEP=N,DEP=M"
        )
    if len(text.strip()) > 30 or int(text) > MAX_EVENTS:
        raise CpunetError(f"`events`: {text[:60]!r} are too many; at most {MAX_EVENTS}")
    return int(text)
