"""Properties of a fitted readout that no readout has, in words."""

from __future__ import annotations

from collections.abc import Mapping

# Limits of the fraction of charge that arrives late; an overshoot makes it a few percent
# negative.
MAX_NEGATIVE, MAX_SLOW = -0.25, 0.5
DRIFT = {1: "drift-time scale", 2: "its change with time"}  # by number of terms


def beyond(parameters: Mapping[str, float]) -> list[str]:
    """Properties of a fitted chain that no readout has, in words.

    Parameters
    ----------
    parameters
        Parameters from `ElectronicsResponse.describe`.

    Examples
    --------
    >>> beyond({"pole_1_ns": 40.0, "slow_100_ns": -0.5, "slow_400_ns": -0.2})
    ['70 % of the charge would arrive too early, which electronics cannot cause; see the fit']
    """
    if "deviation" in parameters:  # the parts of its chain are not what it consists of
        return []
    slow = sum(value for name, value in parameters.items() if name.startswith("slow_"))
    if MAX_NEGATIVE <= slow <= MAX_SLOW:
        return []
    how = "late, as of slower pulses than simulated"
    if slow < 0:
        how = "too early, which electronics cannot cause"
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
    if (gain := gains.get(DRIFT[1], "").partition("; ")[2]) != "":
        size += f" ({gain})"
    how = ("warmer", "a lower") if stretch > 0 else ("colder", "a higher")
    cause = "{} detector, at {} bias".format(*how)
    return [f"{size}, as in a {cause} or with other impurities: cpunet calibrate tells which"]


def _longer(stretch: float) -> str:
    return f"{100 * abs(stretch):.1f} % {'longer' if stretch > 0 else 'shorter'}"
