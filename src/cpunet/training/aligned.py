"""Pulses of both sides read alike: at every sample, aligned at half of their height.

Simulated and measured pulses pass the same reading, so that what it does to a pulse with noise
cancels.  Between samples, pulses are cubics through four of them (Catmull-Rom).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.pulses.parameters import current_amplitude_kernel
from cpunet.recipes.schema import MatchingConfig

Values = npt.NDArray[np.float64]
Floats = npt.NDArray[np.floating[Any]]
Samples = npt.NDArray[np.intp]

EARLY = 0.05  # of the height, from which the rise to half of it is taken
STEEPEST_NS = 1280.0  # after the half height, in which the steepest point lies
STEPS = 4  # of Newton's method for the crossing within a sample
FLATTEST = 1e-4  # slope per sample at the half height
TIE = 1e-6


@dataclass(frozen=True, eq=False)
class Frame:
    """What is read of a pulse; numbers of samples from its half height.

    Parameters
    ----------
    dt_ns
        Sampling period in ns.
    before, after
        Samples read before the half height, and after it.
    base, level
        First and last sample of the baseline and of the level, whose difference is the height.
    taps
        Weights of the current amplitude, see `current_amplitude_kernel`.
    """

    dt_ns: float
    before: int
    after: int
    base: tuple[int, int]
    level: tuple[int, int]
    taps: npt.NDArray[np.float32]

    @classmethod
    def of(cls, config: MatchingConfig) -> Frame:
        """The frame of a recipe at its sampling period."""
        after = config.samples(config.after_ns) - 2  # the cubic needs two more samples
        first, last = (-config.samples(ns) for ns in config.baseline_ns)
        level = after - config.samples(config.level_ns), after
        taps, dt_ns = current_amplitude_kernel(config.sampled_ns), config.sampled_ns
        return cls(dt_ns, config.samples(config.before_ns), after, (first, last), level, taps)

    @property
    def length(self) -> int:
        """Samples of an aligned pulse."""
        return self.before + self.after

    @property
    def reach(self) -> int:
        """Samples before and after its place that the current amplitude depends on."""
        return int(self.taps.shape[1]) // 2


@dataclass(frozen=True, eq=False)
class Aligned:
    """Pulses of unit height as they are read, and where.

    Parameters
    ----------
    pulses, slopes
        Values and derivatives per sample, shape (pulses, samples).
    log_amplitude, rise
        Logarithm of the current amplitude; samples from `EARLY` to half of the height.
    sample, part
        First sample of the record from the half height on, and how far this is after the one
        before.
    height
        Height in the record.
    early, early_part
        The same as `sample` for the beginning of the rise, in the aligned pulse.
    steepest, step
        Sample of the current amplitude in the record, and step within it.
    """

    pulses: Floats
    slopes: Floats
    log_amplitude: Values
    rise: Values
    sample: Samples
    part: Values
    height: Values
    early: Samples
    early_part: Values
    steepest: Samples
    step: Samples

    def __len__(self) -> int:
        return len(self.pulses)

    def __getitem__(self, rows: Any) -> Aligned:
        return Aligned(*(getattr(self, part.name)[rows] for part in fields(self)))


def read(records: Floats, frame: Frame) -> Aligned:
    """Align pulses of any height in records that contain the frame about their half height."""
    rows, (before, after) = np.arange(len(records)), (frame.before, frame.after)
    sample = np.argmax(records >= 0.5 * records.max(axis=1, keepdims=True), axis=1)
    for _ in range(2):
        base, top = (
            stretch(records, sample + first, last - first).mean(axis=1, dtype=np.float64)
            for first, last in (frame.base, frame.level)
        )
        sample = np.argmax(records >= 0.5 * (base + top)[:, np.newaxis], axis=1)
    height = top - base

    def scaled(first: int, length: int) -> Floats:
        part = stretch(records, sample + first, length) - base[:, np.newaxis]
        return np.asarray(part / height[:, np.newaxis], records.dtype)

    part = _half_height(scaled(-2, 4).astype(float))
    weights, derivatives = cubic(part)
    around = scaled(-before - 2, before + after + 3)
    pulses, slopes = between(around, weights), between(around, derivatives)
    log_amplitude, place, step = _amplitude(
        np.diff(scaled(-before, before + round(STEEPEST_NS / frame.dt_ns)), axis=1), frame
    )
    early = before - 1 - np.argmax(pulses[:, before - 1 :: -1] < EARLY, axis=1)
    early = early.clip(1, before - 1)
    low, high = pulses[rows, early].astype(float), pulses[rows, early + 1].astype(float)
    early_part = ((EARLY - low) / np.maximum(high - low, 1e-6)).clip(0, 1)
    order = TIE * rows / len(rows)  # ranks differ where values are at a limit
    return Aligned(
        pulses,
        slopes,
        log_amplitude + order,
        before - early - early_part + order,
        sample,
        part,
        height,
        early,
        early_part,
        sample - before + place,
        step,
    )


def _half_height(four: Values) -> Values:
    """Where the cubic between the middle two of four samples is 0.5, shape (pulses,)."""
    part = (0.5 - four[:, 1]) / (four[:, 2] - four[:, 1])
    for _ in range(STEPS):
        weights, derivatives = cubic(part)
        off = (weights.T * four).sum(axis=1) - 0.5
        slope = np.maximum((derivatives.T * four).sum(axis=1), FLATTEST)
        part = np.clip(part - off / slope, 0, 1)
    return np.asarray(part)


def _amplitude(current: Floats, frame: Frame) -> tuple[Values, Samples, Samples]:
    """Logarithm of the highest smoothed current, its sample, and step within it.

    It is searched three samples before and after the steepest of the sums over three.
    """
    reach, edge = frame.reach, frame.reach + 3
    three = (current[:, :-2] + current[:, 1:-1] + current[:, 2:])[:, edge:-edge]
    place = three.argmax(axis=1) + edge + 1
    near = np.take_along_axis(current, place[:, np.newaxis] + np.arange(-edge, edge + 1), 1)
    windows = np.lib.stride_tricks.sliding_window_view(near, 2 * reach + 1, axis=1)
    smooth = (windows @ frame.taps.T).reshape(len(current), -1)  # (pulses, 7 * steps)
    best, steps = smooth.argmax(axis=1), len(frame.taps)
    highest = np.maximum(smooth.max(axis=1).astype(float), 1e-4)
    return np.log(highest), place - 3 + best // steps, best % steps


def cubic(part: Values) -> tuple[Values, Values]:
    """Weights of four samples at `part` after the second, and derivatives, shape (4, n).

    Examples
    --------
    >>> weights, derivatives = cubic(np.array([0.5]))
    >>> float(weights[:, 0] @ [0, 1, 2, 3]), float(derivatives[:, 0] @ [0, 1, 2, 3])
    (1.5, 1.0)
    """
    square, cube = part**2, part**3
    weights = [
        -part + 2 * square - cube,
        2 - 5 * square + 3 * cube,
        part + 4 * square - 3 * cube,
        cube - square,
    ]
    derivatives = [
        -1 + 4 * part - 3 * square,
        9 * square - 10 * part,
        1 + 8 * part - 9 * square,
        3 * square - 2 * part,
    ]
    return 0.5 * np.array(weights), 0.5 * np.array(derivatives)


def stretch(records: Floats, first: Samples, length: int) -> Floats:
    """``records[i, first[i] : first[i] + length]``; 0 before a record, its last value after."""
    at = first[:, np.newaxis] + np.arange(length)
    samples = np.take_along_axis(records, at.clip(0, records.shape[1] - 1), axis=1)
    if at.min(initial=0) < 0:
        samples[at < 0] = 0
    return samples


def between(samples: Floats, weights: Values) -> Floats:
    """Rows of samples interpolated by the weights of `cubic`: three samples fewer."""
    length, own = samples.shape[1] - 3, weights.astype(samples.dtype)[:, :, np.newaxis]
    values: Floats = sum(own[j] * samples[:, j : j + length] for j in range(4))
    return values
