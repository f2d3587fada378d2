"""Find the parts of a pulse that a poor fit does not describe, and the likely causes.

A readout is the same for all pulses and does not shape the onset.  The parts that are off
therefore distinguish physics, slow components, pile-up tails, and energies.

With enough pulses any chain differs significantly from the true one: chi-square grows with
their number.  What matters is the effect of the difference on the current amplitude, which
users cut on.  It is therefore also given as the shift of the current amplitude (A of A/E) that
would best match the translated distribution to the data.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cpunet.networks.response_layer import Readout
from cpunet.training.moments import Readings, Values
from cpunet.training.optimal_weights import ConditionalFunctions
from cpunet.training.response_problem import Band

OFF = 4.0  # minimum root mean square pull of the moments of a part
AS_MUCH = 0.3  # other parts are reported from this fraction of the worst one
# An onset that is off by more than this is not just the result of fitting what follows it.
PHYSICS = 8.0
# Limits of the fraction of charge that arrives late; an overshoot makes it a few percent
# negative.
MAX_NEGATIVE, MAX_SLOW = -0.25, 0.5
ONSET, TOP, TAIL = -8, 15, 84  # limits of the parts in samples from the half maximum
_SAMPLES = re.compile(r"samples (-?\d+) to (-?\d+)")


@dataclass(frozen=True)
class Part:
    """A part of the pulses, the likely cause of a deviation, and a test of it.

    Parameters
    ----------
    name
        Name in words.
    cause
        Most likely cause of a deviation.
    remedy
        How to test that.
    """

    name: str
    cause: str
    remedy: str


ONSET_PART = Part(
    "the onset",
    "no readout shapes it: the physics simulated are not those of the detector",
    "cpunet calibrate finds temperature and impurities",
)
PARTS = {
    "onset": ONSET_PART,
    "edge": Part(
        "the edge",
        "the bandwidth is of another kind, or the physics differ",
        "cpunet calibrate; cpunet response tells what was fitted",
    ),
    "top": Part(
        "the top",
        "charge that arrives late with times that the recipe does not have, or a ringing",
        "--set generator.slow_ns=[…]",
    ),
    "tail": Part(
        "the tail",
        "in-trace pile-up, pile-up tails too few to be sure of, or a decay that the "
        "recipe does not have",
        "cpunet info tells of pile-up tails; --set generator.fast_decays_us=[…]",
    ),
    "amplitude": Part(
        "the current amplitude",
        "another detector, or other energies than simulated",
        "cpunet check compares both sides",
    ),
}


def parts_off(pulls: Mapping[str, float]) -> dict[str, float]:
    """Root mean square pulls of the parts that are off: a clearly wrong onset, then the worst.

    Parameters
    ----------
    pulls
        Pulls of the moments by name, from a fit.

    Examples
    --------
    >>> parts_off({"samples -40 to -25": 9.0, "samples 140 to 180": -1.0, "tail slope": 30.0})
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
    return [
        f"{PARTS[part].name} is off by {size:.0f} σ: {PARTS[part].cause}; try: "
        + PARTS[part].remedy
        for part, size in parts_off(pulls).items()
    ]


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
    if slow < MAX_NEGATIVE:
        return [
            f"{-100 * slow:.0f} % of the charge would arrive too early, which no readout does; "
            "see the fit"
        ]
    if slow > MAX_SLOW:
        return [
            f"{100 * slow:.0f} % of the charge would arrive late, as of slower pulses than "
            "simulated; see the fit"
        ]
    return []


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
        return "amplitude"
    if name == "tail slope":
        return "tail"
    match = _SAMPLES.fullmatch(name)
    if match is None:
        return ""
    first, stop = map(int, match.groups())
    if stop <= ONSET:
        return "onset"
    if first < TOP:
        return "edge"
    return "top" if first < TAIL else "tail"


BINS = 32  # of the logarithm of the amplitude
STEP = 0.002  # of the logarithm of the amplitude, for the derivative
NEAR = 0.02  # maximum shift in which densities are linear without doubt


class _Shift(NamedTuple):
    """Shift by a linear fit, the chi-square where it starts, and the shift of the mean."""

    chi_square: float
    shift: float
    error: float
    of_mean: float


def amplitude_shift(response: Readout, bands: Sequence[Band]) -> tuple[float, float]:
    """Relative shift that the translated current amplitudes need, and its error.

    It is a least-squares fit to the densities of its logarithm, with their covariance from the
    data's events.  If the mean logarithms differ much, the fit starts from their difference,
    unless the densities agree better without it.

    Parameters
    ----------
    response
        Response that translates the simulated pulses.
    bands
        Bands to compare.
    """
    found = _linear_fit(response, bands, 0.0)
    if abs(found.of_mean) > NEAR:
        found = min(found, _linear_fit(response, bands, found.of_mean))
    return found.shift, found.error


def _linear_fit(response: Readout, bands: Sequence[Band], start: float) -> _Shift:
    """Fit from amplitudes that are already shifted by `start`."""
    chi_square = weight = weighted = weight_of_mean = weighted_mean = 0.0
    for band in bands:
        functions = ConditionalFunctions.of(band.moments, BINS)
        density, slope, mean = _density(band, functions, response, start)
        logs = band.moments.data.log_amplitude
        values = functions.density(logs)
        apart = values.mean(axis=0) - density
        inverse = np.linalg.inv(np.cov(values.T) / band.pairs + 1e-12 * np.eye(len(slope)))
        chi_square += float(apart @ inverse @ apart)
        weight += float(slope @ inverse @ slope)
        weighted += float(slope @ inverse @ apart)
        weight_of_mean += band.pairs
        weighted_mean += band.pairs * float(logs.mean() - mean)
    weight = max(weight, 1.0)  # an error of more than 100 % is that of no overlap
    shift = start + weighted / weight
    return _Shift(chi_square, shift, weight**-0.5, weighted_mean / weight_of_mean)


def _density(
    band: Band, functions: ConditionalFunctions, response: Readout, start: float
) -> tuple[Values, Values, Values]:
    """Mean densities of translated amplitudes, derivatives in the shift, and mean logarithm."""

    def of(readings: Readings) -> tuple[Values, ...]:
        logs, weights = readings.log_amplitude, readings.weights
        shifts = (start, start + STEP, start - STEP)
        return (*(weights @ functions.density(logs + s) for s in shifts), weights @ logs)

    (here, up, down, total), n = band.sim.sums(response, of)
    return here / n, (up - down) / (2 * STEP * n), total / n
