"""The moments of translated pulses with exact derivatives.

Fits need derivatives that differences do not give: records have seven digits, and
noise moves a half maximum by a sample here and there.  Weak directions of a fit, in which large
changes nearly cancel, would be lost in that.  Here the samples at which a record is read are
found first, by the rules of `cpunet.training._record_kernels` and without derivatives.  What is
read there is linear in a record, so its derivatives are read alike; what follows from it is in
the graph.  Where a window moves with the half maximum, by whole samples, the derivative is that
of its mean position.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import scipy.fft

from cpunet.networks.generators import stretch
from cpunet.networks.response_layer import (
    ElectronicsResponse,
    Floats,
    Spectrum,
    current_spectrum,
    padded_length,
)
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import current_amplitude_kernel
from cpunet.training.dual_numbers import Dual
from cpunet.training.moments import Moments, Readings, Rows, aligned_records
from cpunet.training.translated import SimulatedSide, in_threads

T = TypeVar("T")
BLOCK = 128  # pulses at a time: each has a record for every parameter

NO_WEIGHTS = np.empty(0)  # of readings with derivatives; those of the set count
# Functions of each pulse, as of `Moments`.
Functions = Callable[[Readings], Any]


class Ways(NamedTuple):
    """A readout, and how records change with its coordinates.

    Parameters
    ----------
    response
        The readout.
    of_transfer
        Derivatives of its transfer, shape (coordinates, frequencies).
    of_pulses
        Derivatives of some of the pulses that enter it, shape (further coordinates, pulses,
        samples), for their rows.
    """

    response: ElectronicsResponse
    of_transfer: Spectrum
    of_pulses: Callable[[slice], FloatArray]


class Samples(NamedTuple):
    """Samples at which records are read, each of shape (pulses,)."""

    level: Rows  # half maximum that baseline and level refer to
    half: Rows  # half maximum of the normalised record
    tail: Rows  # start of the tail
    steepest: Rows  # centre of the current amplitude, and its phase
    phase: Rows
    time: FloatArray  # of the half maximum after its sample


class DifferentiableReadings:
    """`Moments.read` with derivatives.

    Parameters
    ----------
    moments
        Moments defined by the data.
    last
        Sample after all half maxima.
    """

    def __init__(self, moments: Moments, last: int) -> None:
        self.window = w = moments.window(last)
        self.matrix = moments.quantities
        self.offset = np.zeros(self.matrix.shape[1], np.float32)
        self.offset[-len(moments.offset) :] = moments.offset
        self.centres, self.spreads = (
            values.astype(np.float32) for values in (moments.centres, moments.spreads)
        )
        self.weights = np.asarray(current_amplitude_kernel(w.dt_ns), np.float32)
        lever = np.arange(w.fit_samples) - 0.5 * (w.fit_samples - 1)
        self.lever = (lever / (lever @ lever)).astype(np.float32)
        self.sum = self.matrix.sum(axis=0)
        sizes = [1, 1, 2, 1, self.matrix.shape[1], w.fit_samples]
        self.ends = np.cumsum(sizes)[:-1]

    def parts(self, records: Floats, at: Samples) -> FloatArray:
        """All of the records that is read, shape (..., pulses, parts); linear in them."""
        w, width = self.window, self.weights.shape[1]
        base = stretch(records, at.level, -w.base_first, -w.base_stop)
        top = stretch(records, at.level, w.after - w.level_samples, w.after)
        time = at.time[:, np.newaxis]

        def between(samples: Floats) -> Floats:
            return np.asarray(samples[..., :-1] + time * np.diff(samples))

        centre = at.half - w.before + at.steepest
        current = np.diff(between(stretch(records, centre, -(width // 2), width // 2 + 3)))
        around = between(stretch(records, at.half, -w.before, w.after + 1))
        return np.concatenate(
            [
                base.mean(axis=-1, keepdims=True),
                top.mean(axis=-1, keepdims=True),
                stretch(records, at.half, 0, 2),
                (current * self.weights[at.phase]).sum(axis=-1, keepdims=True),
                around @ self.matrix,
                stretch(records, at.tail, 0, w.fit_samples),
            ],
            axis=-1,
        )

    def moving(self, records: FloatArray, at: Samples) -> FloatArray:
        """Changes of the parts of records if they are read a sample later."""
        early, late = np.zeros_like(at.time), np.ones_like(at.time)
        later = at._replace(level=at.level + 1, tail=at.tail + 1, time=late)
        return self.parts(records, later) - self.parts(records, at._replace(time=early))

    def read(self, parts: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Linear readings and logarithms of the current amplitude of the parts of records."""
        base, top, _, current, linear, tail = np.split(parts, self.ends, axis=-1)
        scale = np.float32(self.window.tail_level) / (top - base)
        linear = (linear - base * self.sum) * scale - self.offset
        slope = np.log(np.maximum((tail - base) * scale, np.float32(1e-3))) @ self.lever
        whole = np.concatenate([linear, slope[:, np.newaxis]], axis=-1)
        amplitude = np.log(np.maximum(current * scale, np.float32(1e-4)))
        return (whole - self.centres) / self.spreads, amplitude[:, 0]

    def slopes(
        self, parts: FloatArray, moving: FloatArray, changes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives of these, from those of the parts (coordinates, pulses, parts)."""
        base, top, half, current, linear, tail = np.split(parts, self.ends, axis=-1)
        of_base, of_top, of_half, of_current, of_linear, of_tail = np.split(
            changes, self.ends, axis=-1
        )
        later_base, later_top, _, later_current, later_linear, later_tail = np.split(
            moving, self.ends, axis=-1
        )
        height, rise = top - base, np.maximum(half[:, 1:] - half[:, :1], np.float32(1e-6))
        level = np.float32(self.window.level / self.window.tail_level)
        time = (level * height + base - half[:, :1]) / rise
        of_half = of_half[..., :1] + time * (of_half[..., 1:] - of_half[..., :1])

        def of_time(of_zero: FloatArray, of_level: FloatArray) -> FloatArray:
            """Derivatives of the time at which a record is half as high."""
            return np.asarray((of_zero + level * (of_level - of_zero) - of_half) / rise)

        moved = of_time(of_base, of_top)  # the windows of base, top and tail move, too
        of_zero, of_level = of_base + moved * later_base, of_top + moved * later_top
        of_time_again = of_time(of_zero, of_level)
        of_scale = (of_zero - of_level) / height
        scale = np.float32(self.window.tail_level) / height
        of_linear = of_linear + of_time_again * later_linear - of_zero * self.sum
        of_linear = (of_linear + (linear - base * self.sum) * of_scale) * scale
        of_slope = ((of_tail + moved * later_tail - of_zero) / (tail - base)) @ self.lever
        of_amplitude = (of_current + of_time_again * later_current) / current + of_scale
        whole = np.concatenate([of_linear, of_slope[..., np.newaxis]], axis=-1)
        return np.asarray(whole / self.spreads), of_amplitude[..., 0]

    def samples(self, records: FloatArray) -> Samples:
        """Samples at which noisy records are read, by the compiled loops."""
        *_, places = aligned_records(records.copy(), self.window)
        level, half, time, tail, steepest, phase = places.T
        whole = [samples.astype(np.intp) for samples in (level, half, tail, steepest, phase)]
        return Samples._make([*whole, time.astype(np.float32)])


class DifferentiableSet:
    """A set of simulated pulses whose functions have derivatives.

    Parameters
    ----------
    sim
        The pulses, their noise, and the moments that they are compared by.
    """

    def __init__(self, sim: SimulatedSide) -> None:
        self.sim, self.readings = sim, DifferentiableReadings(sim.moments, sim.last)
        self.padded = padded_length(sim.length)
        self.weights = sim.weights.astype(np.float32)

    def records(self, spectra: Spectrum, transfer: Spectrum) -> FloatArray:
        """Noise-free records of unit height, from spectra of the current, before `scaled`."""
        records = scipy.fft.irfft(spectra * transfer, self.padded, overwrite_x=True)
        return np.asarray(records[..., : self.sim.length])

    def height(self, records: FloatArray) -> FloatArray:
        """Mean long after the pulse over the nominal level, shape (..., pulses, 1)."""
        plateau = records[..., self.sim.plateau].mean(axis=-1, keepdims=True)
        return np.asarray(plateau / np.float32(self.sim.moments.preparation.tail_level))

    def blocks(
        self,
        ways: Ways,
        functions: Functions,
        of: Callable[[int, FloatArray, FloatArray, FloatArray], T],
        *,
        draws: int | None = None,
    ) -> list[T]:
        """What is made of functions and derivatives of each block of pulses and draw of noise.

        Parameters
        ----------
        ways
            Readout and its derivatives.
        functions
            Functions of each pulse.
        of
            Called in several threads with the first pulse, the functions (pulses, functions),
            derivatives (coordinates, pulses, functions), and the weights of the pulses.
        draws
            Number of draws to use; None for all.
        """
        response = ways.response
        self.sim.forget_unless(response)
        transfer = response.transfer(self.padded).astype(np.complex64)
        of_transfer = ways.of_transfer.astype(np.complex64)[:, np.newaxis]

        def one(first: int) -> list[T]:
            spectra = self.sim.spectrum(response, first, BLOCK)
            rows = slice(first, first + len(spectra))
            clean, moved = self.records(spectra, transfer), self.records(spectra, of_transfer)
            if len(further := ways.of_pulses(rows)):
                changes = current_spectrum(further, self.padded, self.sim.dt_ns)
                moved = np.concatenate([moved, self.records(changes, transfer)])
            heights = self.height(clean), self.height(moved)
            clean = clean / heights[0]
            results = []
            for draw in range(len(self.sim.noise.factor))[:draws]:
                noisy = self.sim.noise.add(clean, draw, first)
                at = self.readings.samples(noisy)
                parts, moving = self.readings.parts(noisy, at), self.readings.moving(noisy, at)
                of_moved = self.readings.parts(moved, at)
                changes = of_moved - self.readings.parts(clean, at) * heights[1]
                slopes = self.readings.slopes(
                    parts, moving, np.asarray(changes / heights[0], np.float32)
                )
                values = self.readings.read(parts)
                read: list[Any] = [Dual(*one) for one in zip(values, slopes, strict=True)]
                made = functions(Readings(read[0], read[1], NO_WEIGHTS))
                results.append(of(first, made.value, made.slopes, self.weights[rows]))
            return results

        blocks = in_threads(one, range(0, len(self.sim), BLOCK))
        return [part for block in blocks for part in block]

    def slopes(
        self, ways: Ways, functions: Functions, *, draws: int | None = None
    ) -> npt.NDArray[np.float64]:
        """Derivatives of the means of the functions, shape (functions, coordinates)."""

        def of(
            first: int, values: FloatArray, moved: FloatArray, weights: FloatArray
        ) -> tuple[FloatArray, float]:
            return (weights @ moved).astype(float), float(weights.sum())

        sums, n = zip(*self.blocks(ways, functions, of, draws=draws), strict=True)
        return np.asarray(np.sum(sums, axis=0).T / sum(n))
