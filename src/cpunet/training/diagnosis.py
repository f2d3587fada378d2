"""What a poor fit of a readout means, in words.

They tell the parts of a pulse that the fit does not describe, and the likely causes.  A readout
is the same for all pulses and does not shape the onset.  The parts that are off therefore
distinguish physics, slow components, pile-up tails, and energies.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

OFF = 4.0  # minimum root mean square pull of the moments of a part
AS_MUCH = 0.3  # other parts are reported from this fraction of the worst one
# An onset that is off by more than this is not just the result of fitting what follows it.
PHYSICS = 8.0
# Limits of the fraction of charge that arrives late; an overshoot makes it a few percent
# negative.
MAX_NEGATIVE, MAX_SLOW = -0.25, 0.5
# Limits of the parts in ns from the half maximum.
ONSET_NS, TOP_NS, TAIL_NS = -128.0, 240.0, 1344.0
_STRETCH = re.compile(r"(-?[\d.e+]+) to (-?[\d.e+]+) ns")

# Likely cause of a deviation of each part of a pulse, and a test of it.
PARTS = {
    "onset": "no readout shapes it: the physics simulated are not those of the detector; try: "
    "cpunet calibrate finds temperature and impurities",
    "edge": "the bandwidth is of another kind, or the physics differ; try: cpunet calibrate; "
    "cpunet response tells what was fitted",
    "top": "charge that arrives late with times that the recipe does not have, or a ringing; "
    "try: --set generator.slow_ns=[…]",
    "tail": "in-trace pile-up, pile-up tails too few to be sure of, or a decay that the recipe "
    "does not have; try: cpunet info --quality tells of pile-up tails; "
    "--set generator.fast_decays_us=[…]",
    "current amplitude": "another detector, or other energies than simulated; try: cpunet "
    "check compares both sides",
}


def parts_off(pulls: Mapping[str, float]) -> dict[str, float]:
    """Root mean square pulls of the parts that are off: a clearly wrong onset, then the worst.

    Parameters
    ----------
    pulls
        Pulls of the moments by name, from a fit.

    Examples
    --------
    >>> parts_off({"-640 to -400 ns": 9.0, "2240 to 2880 ns": -1.0, "tail slope": 30.0})
    {'onset': 9.0, 'tail': 21.2}
    """
    squares: dict[str, list[float]] = {}
    for name, pull in pulls.items():
        part = _part(name.split(": ")[-1])
        if part:
            squares.setdefault(part, []).append(pull**2)
    sizes = {part: round(float(np.sqrt(np.mean(s))), 1) for part, s in squares.items()}
    worst = max(sizes.values(), default=0.0)
    off = {part: size for part, size in sizes.items() if size > OFF and size > AS_MUCH * worst}

    def order(part: str) -> tuple[bool, float]:
        return part == "onset" and off[part] > PHYSICS, off[part]

    return {part: off[part] for part in sorted(off, key=order, reverse=True)}


def diagnosis(pulls: Mapping[str, float]) -> list[str]:
    """One line for each part that is off: by how much, why, and what to try.

    Parameters
    ----------
    pulls
        Pulls of the moments by name, from a fit.
    """
    off = parts_off(pulls).items()
    return [f"the {part} is off by {size:.0f} σ: {PARTS[part]}" for part, size in off]


def beyond(parameters: Mapping[str, float]) -> list[str]:
    """Properties of a fitted chain that no readout has, in words.

    Parameters
    ----------
    parameters
        Parameters from `ElectronicsResponse.describe`.

    Examples
    --------
    >>> beyond({"pole_1_ns": 40.0, "slow_100_ns": -0.5, "slow_400_ns": -0.2})
    ['70 % of the charge would arrive too early, which no readout does; see the fit']
    """
    slow = sum(value for name, value in parameters.items() if name.startswith("slow_"))
    if MAX_NEGATIVE <= slow <= MAX_SLOW:
        return []
    how = "late, as of slower pulses than simulated"
    if slow < 0:
        how = "too early, which no readout does"
    return [f"{100 * abs(slow):.0f} % of the charge would arrive {how}; see the fit"]


def stretched(parameters: Mapping[str, float], gains: Mapping[str, str] = {}) -> list[str]:
    """Say in words that the simulated drift was stretched, if it was, and what that may mean.

    Parameters
    ----------
    parameters
        Parameters from `ElectronicsResponse.describe`.
    gains
        What held-out pulses say of each part that was tried.

    Examples
    --------
    >>> print(stretched({"drift_stretch": 0.052})[0])
    charges drift for 5.2 % longer than simulated, as in a warmer detector, at a lower bias or \
with other impurities: cpunet calibrate tells which
    """
    stretch = parameters.get("drift_stretch")
    if stretch is None:
        return []
    change = parameters.get("drift_stretch_per_us", 0.0)
    size = f"charges drift for {_longer(stretch + change)} than simulated"
    if change:
        size += f" in the last microsecond, {_longer(stretch)} near its end"
    if (gain := gains.get("a stretch of the drift", "").partition("; ")[2]) != "":
        size += f" ({gain})"
    cause = (
        "warmer detector, at a lower bias" if stretch > 0 else "colder one, at a higher bias"
    )
    return [f"{size}, as in a {cause} or with other impurities: cpunet calibrate tells which"]


def _longer(stretch: float) -> str:
    return f"{100 * abs(stretch):.1f} % {'longer' if stretch > 0 else 'shorter'}"


def _part(name: str) -> str:
    if name.startswith("current amplitude"):
        return "current amplitude"
    if name == "tail slope":
        return "tail"
    match = _STRETCH.fullmatch(name)
    if match is None:
        return ""
    first, stop = map(float, match.groups())
    if stop <= ONSET_NS:
        return "onset"
    if first < TOP_NS:
        return "edge"
    return "top" if first < TAIL_NS else "tail"
