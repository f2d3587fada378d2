"""Pulses of both sides read alike: at every sample, aligned at half of their height.

Also, how all that is read of a pulse changes with its record.

Simulated and measured pulses pass the same reading, so that what it does to a pulse with noise
cancels.  Between samples, pulses are cubics through four of them (Catmull-Rom).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.signal import fftconvolve

from cpunet.networks.response_layer import deviation_lags
from cpunet.pulses.parameters import current_amplitude_kernel
from cpunet.recipes.schema import MatchingConfig

if TYPE_CHECKING:
    from cpunet.training.pulse_sets import Sides

Values = npt.NDArray[np.float64]
Floats = npt.NDArray[np.floating[Any]]
Samples = npt.NDArray[np.intp]

EARLY = 0.05  # of the height, from which the rise to half of it is taken
STEEPEST_NS = 1280.0  # after the half height, in which the steepest point lies
STEPS = 4  # of Newton's method for the crossing within a sample
FLATTEST = 1e-4  # slope per sample at the half height
TIE = 1e-6
SINGLE = np.float32  # derivatives need seven digits


class Frame:
    """What is read of a pulse; numbers of samples from its half height.

    Parameters
    ----------
    config
        Times of a recipe, at its sampling period.

    Attributes
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

    def __init__(self, config: MatchingConfig) -> None:
        self.dt_ns, self.before = config.sampled_ns, config.samples(config.before_ns)
        self.after = config.samples(config.after_ns) - 2  # the cubic needs two more samples
        first, last = (-config.samples(ns) for ns in config.baseline_ns)
        self.base = first, last
        self.level = self.after - config.samples(config.level_ns), self.after
        self.taps = current_amplitude_kernel(self.dt_ns)


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
    rows, before = np.arange(len(records)), frame.before
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

    # where the cubic between the middle two of four samples is 0.5
    four = scaled(-2, 4).astype(float)
    part = (0.5 - four[:, 1]) / (four[:, 2] - four[:, 1])
    for _ in range(STEPS):
        weights, derivatives = cubic(part)
        off = (weights.T * four).sum(axis=1) - 0.5
        slope = np.maximum((derivatives.T * four).sum(axis=1), FLATTEST)
        part = np.clip(part - off / slope, 0, 1)
    weights, derivatives = cubic(part)
    around = scaled(-before - 2, before + frame.after + 3)
    pulses, slopes = between(around, weights), between(around, derivatives)

    # the highest smoothed current, three samples before and after the steepest sum over three
    current = np.diff(scaled(-before, before + round(STEEPEST_NS / frame.dt_ns)), axis=1)
    edge, steps = frame.taps.shape[1] // 2 + 3, len(frame.taps)
    three = (current[:, :-2] + current[:, 1:-1] + current[:, 2:])[:, edge:-edge]
    place = three.argmax(axis=1) + edge + 1
    near = np.take_along_axis(current, place[:, np.newaxis] + np.arange(-edge, edge + 1), 1)
    windows = np.lib.stride_tricks.sliding_window_view(near, frame.taps.shape[1], axis=1)
    smooth = (windows @ frame.taps.T).reshape(len(current), -1)  # (pulses, 7 * steps)
    best = smooth.argmax(axis=1)
    highest = np.maximum(smooth.max(axis=1).astype(float), 1e-4)

    early = before - 1 - np.argmax(pulses[:, before - 1 :: -1] < EARLY, axis=1)
    early = early.clip(1, before - 1)
    low, high = pulses[rows, early].astype(float), pulses[rows, early + 1].astype(float)
    early_part = ((EARLY - low) / np.maximum(high - low, 1e-6)).clip(0, 1)
    order = TIE * rows / len(rows)  # ranks differ where values are at a limit
    return Aligned(
        pulses,
        slopes,
        np.log(highest) + order,
        before - early - early_part + order,
        sample,
        part,
        height,
        early,
        early_part,
        sample - before + (place - 3 + best // steps),
        best % steps,
    )


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


class Derivatives:
    r"""Derivatives in coordinates in which a step response changes, for pulses with noise.

    A record changes by the current at lag l times the change of the response at l.  What is
    read of a pulse changes with its baseline, its height and the time of its half height, too:

    .. math:: dA(t) = \frac{dR(t) - dB}{h} - A \frac{dh}{h} + \dot A(t)\, d\tau.

    Parameters
    ----------
    basis
        Change of the step response at `deviation_lags` per coordinate, shape
        (lags, coordinates).
    sides
        Pulses.
    aligned, heights
        The translated pulses, and heights of their records before.

    Attributes
    ----------
    log_amplitude, rise
        Derivatives of what is read, shape (pulses, coordinates).
    """

    def __init__(self, basis: Values, sides: Sides, aligned: Aligned, heights: Floats) -> None:
        self.sides, self.basis = sides, basis
        self.lags = deviation_lags(sides.frame.dt_ns)
        self.reversed = basis[::-1].astype(SINGLE)
        self.values, self.slopes = (sides.view(of) for of in (aligned.pulses, aligned.slopes))
        level = slice(*(sides.frame.before + at for at in sides.frame.level))
        self.level = aligned.pulses[:, level].mean(axis=0)
        frame, rows = sides.frame, np.arange(len(aligned))
        lags, last = len(basis), int(self.lags[-1])
        height = (aligned.height * heights).astype(SINGLE)[:, np.newaxis]
        weights, _ = cubic(aligned.part)

        def mean(ends: tuple[int, int]) -> Floats:
            first = aligned.sample - 1 - last
            low, high = (
                stretch(sides.charge, first + end, lags) @ self.reversed for end in ends
            )
            return np.asarray((high - low) / SINGLE(ends[1] - ends[0]) / height)

        def charge(sample: Samples) -> Floats:
            first = sample - 2 - last
            samples = stretch(sides.current, first, lags + 3)
            return np.asarray(between(samples, weights) @ self.reversed / height)

        def column(values: Floats) -> Floats:
            return np.asarray(values, SINGLE)[:, np.newaxis]

        self.base = mean(frame.base)
        self.span = mean(frame.level) - self.base
        at_half = charge(aligned.sample) - self.base - SINGLE(0.5) * self.span
        self.time = -at_half / column(aligned.slopes[rows, frame.before])
        early, part = aligned.early, column(aligned.early_part)
        ahead = aligned.pulses[rows, early + 1] - aligned.pulses[rows, early]
        begin = aligned.sample + early - frame.before
        risen = charge(begin) * (1 - part) + charge(begin + 1) * part
        steep = column(aligned.slopes[rows, early]) * (1 - part)
        steep = steep + column(aligned.slopes[rows, early + 1]) * part
        risen = risen - self.base - SINGLE(EARLY) * self.span + self.time * steep
        self.rise = np.where(
            (early > 1)[:, np.newaxis], risen / column(np.maximum(ahead, 1e-5)), 0
        )
        change = np.zeros((len(aligned), basis.shape[1]), SINGLE)
        for step, taps in enumerate(frame.taps):  # of the highest smoothed current
            some = np.flatnonzero(aligned.step == step)
            first = aligned.steepest[some] - last - frame.taps.shape[1] // 2
            records = stretch(sides.current[some], first, lags + frame.taps.shape[1])
            current = np.diff(records, axis=1)
            smooth = sum(tap * current[:, j : j + lags] for j, tap in enumerate(taps))
            change[some] = smooth @ self.reversed
        self.log_amplitude = change / height / column(np.exp(aligned.log_amplitude))
        self.log_amplitude -= self.span
        self.begin = -frame.before - last
        length = frame.after - self.lags[0] - self.begin + 3
        currents = stretch(sides.current, aligned.sample + self.begin - 2, length)
        self.currents = between(currents, weights) / height

    def mean(self, rows: npt.NDArray[np.intp], weights: Floats) -> Values:
        """Change of weighted sums of the stretches, shape (stretches, coordinates).

        Parameters
        ----------
        rows
            Pulses.
        weights
            Weights of these, shape (pulses, stretches).
        """
        weights = np.asarray(weights, SINGLE)
        widths = self.sides.widths[:, np.newaxis]
        currents = weights.T @ self.currents[rows]  # (stretches, times)
        sums = np.zeros((len(currents), currents.shape[1] + 1))
        np.cumsum(currents, axis=1, out=sums[:, 1:])
        low = self.sides.first[:, np.newaxis] - self.sides.frame.before - self.lags - self.begin
        high = np.take_along_axis(sums, low + widths, axis=1)
        change = ((high - np.take_along_axis(sums, low, axis=1)) / widths) @ self.basis
        change -= weights.T @ self.base[rows]
        change += (weights * self.slopes[rows]).T @ self.time[rows]
        change -= (weights * self.values[rows]).T @ self.span[rows]
        return np.asarray(change)

    def each(self, matrix: Values) -> Floats:
        """Change of linear functions of each pulse, shape (pulses, functions, coordinates).

        Parameters
        ----------
        matrix
            Weights of the stretches, shape (stretches, functions).
        """
        widths, n, m = self.sides.widths, matrix.shape[1], self.basis.shape[1]
        weights = np.repeat(matrix / widths[:, np.newaxis], widths, axis=0)
        kernel = fftconvolve(weights[:, :, np.newaxis], self.basis[::-1, np.newaxis], axes=0)
        changes = self.currents @ kernel.reshape(-1, n * m).astype(SINGLE)
        change = changes.reshape(-1, n, m)
        matrix = matrix.astype(SINGLE)
        # samples of the level follow the half height, by whole ones
        falling = np.gradient(self.level).mean()
        span = self.span + self.time * SINGLE(falling)
        change -= self.base[:, np.newaxis] * matrix.sum(axis=0)[:, np.newaxis]
        change += (self.slopes @ matrix)[:, :, np.newaxis] * self.time[:, np.newaxis]
        change -= (self.values @ matrix)[:, :, np.newaxis] * span[:, np.newaxis]
        return np.asarray(change)


class Changes:
    """The same in coordinates of which each changes every record in a way of its own.

    Parameters
    ----------
    sides
        Pulses.
    aligned
        The translated pulses.
    records
        Derivatives of their records of prepared height, each of shape (pulses, samples).

    Attributes
    ----------
    log_amplitude
        Derivatives of the logarithm of the current amplitude, shape (pulses, coordinates).
    """

    def __init__(self, sides: Sides, aligned: Aligned, records: Sequence[Floats]) -> None:
        self.sides, self.changes, of_logs = sides, list[Floats](), []
        frame, height = sides.frame, aligned.height.astype(SINGLE)[:, np.newaxis]
        slopes, middle = aligned.slopes, slice(frame.before, frame.before + 1)
        level = aligned.pulses[:, frame.before + frame.level[0] : frame.before + frame.level[1]]
        falling = SINGLE(np.gradient(level.mean(axis=0)).mean())
        weights, _ = cubic(aligned.part)
        taps, steepest = frame.taps, aligned.steepest - frame.taps.shape[1] // 2
        length = frame.before + frame.after + 3
        for record in records:
            base, top = (
                stretch(record, aligned.sample + first, last - first).mean(
                    axis=1, keepdims=True
                )
                for first, last in (frame.base, frame.level)
            )
            around = stretch(record, aligned.sample - frame.before - 2, length)
            moved = (between(around, weights) - base) / height
            span = (top - base) / height
            time = (SINGLE(0.5) * span - moved[:, middle]) / slopes[:, middle]
            span += time * falling  # samples of the level follow the half height, by whole ones
            self.changes.append(moved - aligned.pulses * span + slopes * time)
            current = np.diff(stretch(record, steepest, taps.shape[1] + 1), axis=1)
            smooth = (current * taps[aligned.step]).sum(axis=1) / aligned.height
            of_logs.append(smooth / np.exp(aligned.log_amplitude) - span[:, 0])
        self.log_amplitude = np.column_stack(of_logs)

    def each(self, matrix: Values) -> Floats:
        """Change of linear functions of each pulse, shape (pulses, functions, coordinates)."""
        views = [self.sides.view(change) @ matrix.astype(SINGLE) for change in self.changes]
        return np.stack(views, axis=2)
