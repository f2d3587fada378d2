"""How aligned pulses and what is read of them change with their records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import fftconvolve

from cpunet.training.aligned import (
    EARLY,
    Aligned,
    Floats,
    Samples,
    Values,
    between,
    cubic,
    stretch,
)
from cpunet.training.comparison import Sides

SINGLE = np.float32  # derivatives need seven digits


@dataclass(frozen=True, eq=False)
class Basis:
    """Coordinates in which a step response changes.

    Parameters
    ----------
    first
        First lag after the step in samples; negative.
    changes
        Change of the step response from this lag on per coordinate, shape (lags, coordinates).
    """

    first: int
    changes: Values

    def __call__(self, sides: Sides, aligned: Aligned, heights: Floats) -> Derivatives:
        """Derivatives of pulses in these coordinates."""
        return Derivatives(sides, aligned, heights, self)

    @property
    def last(self) -> int:
        """Last lag."""
        return self.first + len(self.changes) - 1


class Derivatives:
    r"""Derivatives in the coordinates of a basis, for pulses with a draw of noise.

    A record changes by the current at lag l times the change of the response at l.  What is
    read of a pulse changes with its baseline, its height and the time of its half height, too:

    .. math:: dA(t) = \frac{dR(t) - dB}{h} - A \frac{dh}{h} + \dot A(t)\, d\tau.

    Parameters
    ----------
    sides
        Pulses.
    aligned, heights
        The translated pulses, and heights of their records before.
    basis
        Coordinates.

    Attributes
    ----------
    log_amplitude, rise
        Derivatives of what is read, shape (pulses, coordinates).
    """

    def __init__(self, sides: Sides, aligned: Aligned, heights: Floats, basis: Basis) -> None:
        self.sides, self.basis = sides, basis
        self.reversed = basis.changes[::-1].astype(SINGLE)
        self.values, self.slopes = (sides.view(of) for of in (aligned.pulses, aligned.slopes))
        level = slice(*(sides.frame.before + at for at in sides.frame.level))
        self.level = aligned.pulses[:, level].mean(axis=0)
        frame, rows = sides.frame, np.arange(len(aligned))
        height = (aligned.height * heights).astype(SINGLE)[:, np.newaxis]
        weights, _ = cubic(aligned.part)
        lags = len(basis.changes)

        def mean(ends: tuple[int, int]) -> Floats:
            first = aligned.sample - 1 - basis.last
            low, high = (
                stretch(sides.charge, first + end, lags) @ self.reversed for end in ends
            )
            return np.asarray((high - low) / SINGLE(ends[1] - ends[0]) / height)

        def charge(sample: Samples) -> Floats:
            first = sample - 2 - basis.last
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
        step = column(np.maximum(ahead, 1e-5))
        begin = aligned.sample + early - frame.before
        risen = charge(begin) * (1 - part) + charge(begin + 1) * part
        steep = column(aligned.slopes[rows, early]) * (1 - part)
        steep = steep + column(aligned.slopes[rows, early + 1]) * part
        risen = risen - self.base - SINGLE(EARLY) * self.span + self.time * steep
        self.rise = np.where((early > 1)[:, np.newaxis], risen / step, 0)
        self.log_amplitude = self._amplitude(aligned) / height
        self.log_amplitude /= column(np.exp(aligned.log_amplitude))
        self.log_amplitude -= self.span
        self.begin = -frame.before - basis.last
        length = frame.after - basis.first - self.begin + 3
        currents = stretch(sides.current, aligned.sample + self.begin - 2, length)
        self.currents = between(currents, weights) / height

    def _amplitude(self, aligned: Aligned) -> Floats:
        """Change of the highest smoothed current of a record."""
        frame, (lags, coordinates) = self.sides.frame, self.basis.changes.shape
        change = np.zeros((len(aligned), coordinates), SINGLE)
        for step, weights in enumerate(frame.taps):
            rows = np.flatnonzero(aligned.step == step)
            first = aligned.steepest[rows] - self.basis.last - frame.reach
            records = stretch(self.sides.current[rows], first, lags + 2 * frame.reach + 1)
            current = np.diff(records, axis=1)
            smooth = sum(w * current[:, j : j + lags] for j, w in enumerate(weights))
            change[rows] = smooth @ self.reversed
        return change

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
        widths, basis = self.sides.widths[:, np.newaxis], self.basis
        currents = weights.T @ self.currents[rows]  # (stretches, times)
        sums = np.zeros((len(currents), currents.shape[1] + 1))
        np.cumsum(currents, axis=1, out=sums[:, 1:])
        lags = np.arange(basis.first, basis.last + 1)
        low = self.sides.first[:, np.newaxis] - self.sides.frame.before - lags - self.begin
        high = np.take_along_axis(sums, low + widths, axis=1)
        change = ((high - np.take_along_axis(sums, low, axis=1)) / widths) @ basis.changes
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
        widths, n, m = self.sides.widths, matrix.shape[1], self.basis.changes.shape[1]
        weights = np.repeat(matrix / widths[:, np.newaxis], widths, axis=0)
        kernel = fftconvolve(
            weights[:, :, np.newaxis], self.basis.changes[::-1, np.newaxis], axes=0
        )
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
        taps, steepest = frame.taps, aligned.steepest - frame.reach
        for record in records:
            base, top = (
                stretch(record, aligned.sample + first, last - first).mean(
                    axis=1, keepdims=True
                )
                for first, last in (frame.base, frame.level)
            )
            around = stretch(record, aligned.sample - frame.before - 2, frame.length + 3)
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
