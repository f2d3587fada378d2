"""Mistakes that raw traces betray: wrong polarity, energies of other events, a second rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.pulses.reading.energies import amplitude

Values = npt.NDArray[np.float64]
Traces = npt.NDArray[np.float32]

LOW_KEV = 300.0  # at lower energies, noise can be a good part of an amplitude
# Relative deviation from the common gain of what does not go together, and share of pulses up
# to which amplitudes may differ as much and yet be all alike.
APART, ALIKE = 0.1, 0.1
MIN_PULSES = 30
# Samples over which noise is averaged, least part of the tail on either side of a change of
# rate, and least factors by which noise and slope change there.
SMOOTHED, MARGIN, MIN_NOISE, MIN_SLOPE = 64, 0.1, 1.2, 1.5


def go_down(traces: Traces) -> bool:
    """Whether most traces of shape (pulses, samples) fall from their baselines."""
    if not len(traces):
        return False
    up, down = amplitude(traces), amplitude(-traces)
    return bool(np.mean(down > 2 * np.maximum(up, 0)) > 0.5)


def apart(kev: Values, amplitudes: Values) -> float:
    """Fraction of the pulses whose amplitude does not go with their energy.

    Of a detector and its readout, amplitudes are energies times a gain, but for a few percent
    by trapping, for piled-up and for saturated pulses.  Returns 0 if there are too few, or if
    all amplitudes are alike, as of pulses that were scaled to one height.
    """
    with np.errstate(invalid="ignore"):
        usable = (kev > LOW_KEV) & (amplitudes > 0)
    if usable.sum() < MIN_PULSES:
        return 0.0
    if _far_from_median(amplitudes[usable]) < ALIKE:
        return 0.0
    return _far_from_median(amplitudes[usable] / kev[usable])


def _far_from_median(values: Values) -> float:
    return float(np.mean(np.abs(values / np.median(values) - 1) > APART))


@dataclass(frozen=True)
class SecondRate:
    """A change of the rate within a trace: its sample, and how many samples are averaged."""

    sample: int
    averaged: float

    def __str__(self) -> str:
        return (
            f"noise and slope of the tails change at sample {self.sample}, as if "
            f"{self.averaged:.0f} samples were averaged from there: a second rate"
        )


def second_rate(traces: Traces) -> SecondRate | None:
    """Find where digitisers begin to average samples, which are then further apart in time.

    Averages of m samples have less noise, by the root of m if it is white, and the decay goes
    on m times as fast from sample to sample.

    Parameters
    ----------
    traces
        Raw traces, shape (pulses, samples).
    """
    heights = amplitude(traces)
    good = np.isfinite(heights) & (heights > 0)
    if good.sum() < MIN_PULSES:
        return None
    heights = heights[good]
    start = int(np.median(traces[good].argmax(axis=1))) + SMOOTHED
    tail: Values = traces[good, start:].astype(np.float64)
    n = tail.shape[1]
    margin = max(2 * SMOOTHED, round(MARGIN * n))
    if n < 3 * margin:
        return None
    curvature = np.diff(tail, 2, axis=1)
    noise = np.log(np.median(np.abs(curvature), axis=0) + 1e-9)  # (samples,)
    places = np.arange(margin, n - margin)
    sums = np.concatenate([[0.0], np.cumsum(noise)])
    left = sums[places] / places
    right = (sums[-1] - sums[places]) / (len(noise) - places)
    gain = (left - right) ** 2 * places * (len(noise) - places)
    at = int(places[gain.argmax()])
    lower = float(np.exp(left[gain.argmax()] - right[gain.argmax()]))
    baselines = traces[good].max(axis=1) - heights
    level = np.median((tail - baselines[:, np.newaxis]) / heights[:, np.newaxis], axis=0)
    slopes = [
        np.polyfit(np.arange(len(part)), np.log(np.maximum(part, 1e-3)), 1)[0]
        for part in (level[:at], level[at:])
    ]
    faster = slopes[1] / slopes[0] if slopes[0] < 0 else 0.0
    if lower < MIN_NOISE or faster < MIN_SLOPE:
        return None
    return SecondRate(start + at + 1, faster)
