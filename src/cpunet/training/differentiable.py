"""The moments of translated pulses with exact derivatives.

Fits and networks need derivatives that differences do not give: records have seven digits, and
noise moves a half maximum by a sample here and there.  Weak directions of a fit, in which large
changes nearly cancel, would be lost in that.  Here the samples at which a record is read are
found first, by the rules of `cpunet.training._record_kernels` and without derivatives.  What is
read there is linear in a record, so its derivatives are read alike; what follows from it is in
the graph.  Where a window moves with the half maximum, by whole samples, the derivative is that
of its mean position.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cpunet.networks.generators import stretch
from cpunet.networks.response_layer import (
    ElectronicsResponse,
    current_spectrum,
    padded_length,
)
from cpunet.pulses.parameters import current_amplitude_kernel
from cpunet.training.dual_numbers import Dual
from cpunet.training.moments import Moments, Readings, aligned_records
from cpunet.training.translated import SimulatedSide, in_threads

T = TypeVar("T")
BLOCK = 128  # pulses at a time: each has a record for every parameter

NO_WEIGHTS = np.empty(0)  # of the readings of tensors; those of the set count
# Functions of each pulse, as of `Moments`; these take tensors, too.
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
    of_transfer: Tensor
    of_pulses: Callable[[slice], Tensor]


class Samples(NamedTuple):
    """Samples at which records are read, each of shape (pulses,)."""

    level: Tensor  # half maximum that baseline and level refer to
    half: Tensor  # half maximum of the normalised record
    tail: Tensor  # start of the tail
    steepest: Tensor  # centre of the current amplitude, and its phase
    phase: Tensor
    time: Tensor  # of the half maximum after its sample


class DifferentiableReadings:
    """`Moments.read` in the graph of PyTorch.

    Parameters
    ----------
    moments
        Moments defined by the data.
    last
        Sample after all half maxima.
    """

    def __init__(self, moments: Moments, last: int) -> None:
        self.window = w = moments.window(last)
        self.matrix = torch.from_numpy(moments.quantities)
        self.offset = torch.zeros(self.matrix.shape[1])
        self.offset[-len(moments.offset) :] = torch.from_numpy(moments.offset)
        self.centres, self.spreads = (
            torch.from_numpy(values).float() for values in (moments.centres, moments.spreads)
        )
        self.weights = torch.from_numpy(
            np.asarray(current_amplitude_kernel(w.dt_ns), np.float32)
        )
        lever = torch.arange(w.fit_samples) - 0.5 * (w.fit_samples - 1)
        self.lever = lever / (lever @ lever)
        self.sum = self.matrix.sum(dim=0)
        self.sizes = [1, 1, 2, 1, self.matrix.shape[1], w.fit_samples]

    def __call__(self, records: Tensor) -> Readings:
        """Read noisy records (pulses, samples)."""
        fixed = records.detach()
        at = self.samples(fixed)
        parts, moving = self.parts(fixed, at), self.moving(fixed, at)
        # 0, but has derivatives
        change = self.slopes(parts, moving, (self.parts(records, at) - parts)[None])
        values = self.read(parts)
        linear, amplitude = (a + b[0] for a, b in zip(values, change, strict=True))
        return Readings(linear, amplitude, NO_WEIGHTS)

    def parts(self, records: Tensor, at: Samples) -> Tensor:
        """All of the records that is read, shape (pulses, parts); it is linear in them."""
        w, width = self.window, self.weights.shape[1]
        base = stretch(records, at.level, -w.base_first, -w.base_stop)
        top = stretch(records, at.level, w.after - w.level_samples, w.after)
        time = at.time[:, None]

        def between(samples: Tensor) -> Tensor:
            return torch.lerp(samples[:, :-1], samples[:, 1:], time)

        centre = at.half - w.before + at.steepest
        current = torch.diff(between(stretch(records, centre, -(width // 2), width // 2 + 3)))
        around = between(stretch(records, at.half, -w.before, w.after + 1))
        return torch.cat(
            [
                base.mean(dim=1, keepdim=True),
                top.mean(dim=1, keepdim=True),
                stretch(records, at.half, 0, 2),
                (current * self.weights[at.phase]).sum(dim=1, keepdim=True),
                around @ self.matrix,
                stretch(records, at.tail, 0, w.fit_samples),
            ],
            dim=1,
        )

    def moving(self, records: Tensor, at: Samples) -> Tensor:
        """Changes of the parts of records if they are read a sample later."""
        early, late = torch.zeros_like(at.time), torch.ones_like(at.time)
        later = at._replace(level=at.level + 1, tail=at.tail + 1, time=late)
        return self.parts(records, later) - self.parts(records, at._replace(time=early))

    def read(self, parts: Tensor) -> tuple[Any, Any]:
        """Linear readings and logarithms of the current amplitude of the parts of records."""
        base, top, _, current, linear, tail = torch.split(parts, self.sizes, dim=-1)
        scale = self.window.tail_level / (top - base)
        linear = (linear - base * self.sum) * scale - self.offset
        slope = ((tail - base) * scale).clamp_min(1e-3).log() @ self.lever
        whole = torch.cat([linear, slope[:, None]], dim=-1)
        amplitude = (current * scale).clamp_min(1e-4).log()
        return (whole - self.centres) / self.spreads, amplitude[:, 0]

    def slopes(self, parts: Tensor, moving: Tensor, changes: Tensor) -> tuple[Any, Any]:
        """Derivatives of these, from those of the parts (coordinates, pulses, parts)."""
        base, top, half, current, linear, tail = torch.split(parts, self.sizes, dim=-1)
        of_base, of_top, of_half, of_current, of_linear, of_tail = torch.split(
            changes, self.sizes, dim=-1
        )
        later_base, later_top, _, later_current, later_linear, later_tail = torch.split(
            moving, self.sizes, dim=-1
        )
        height, rise = top - base, (half[:, 1:] - half[:, :1]).clamp_min(1e-6)
        level = self.window.level / self.window.tail_level
        time = (level * height + base - half[:, :1]) / rise
        of_half = torch.lerp(of_half[..., :1], of_half[..., 1:], time)

        def of_time(of_zero: Tensor, of_level: Tensor) -> Tensor:
            """Derivatives of the time at which a record is half as high."""
            return (torch.lerp(of_zero, of_level, level) - of_half) / rise

        moved = of_time(of_base, of_top)  # the windows of base, top and tail move, too
        of_zero, of_level = of_base + moved * later_base, of_top + moved * later_top
        of_time_again = of_time(of_zero, of_level)
        of_scale = (of_zero - of_level) / height
        scale = self.window.tail_level / height
        of_linear = of_linear + of_time_again * later_linear - of_zero * self.sum
        of_linear = (of_linear + (linear - base * self.sum) * of_scale) * scale
        of_slope = ((of_tail + moved * later_tail - of_zero) / (tail - base)) @ self.lever
        of_amplitude = (of_current + of_time_again * later_current) / current + of_scale
        whole = torch.cat([of_linear, of_slope[..., None]], dim=-1)
        return whole / self.spreads, of_amplitude[..., 0]

    def samples(self, records: Tensor) -> Samples:
        """Samples at which noisy records are read, by the compiled loops."""
        *_, places = aligned_records(records.numpy().copy(), self.window)
        level, half, time, tail, steepest, phase = torch.from_numpy(places).unbind(dim=1)
        whole = [samples.long() for samples in (level, half, tail, steepest, phase)]
        return Samples._make([*whole, time.float()])


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
        self.weights = torch.from_numpy(sim.weights).float()

    def records(self, spectra: Tensor, transfer: Tensor) -> Tensor:
        """Noise-free records of unit height, from spectra of the current, before `scaled`."""
        records: Tensor = torch.fft.irfft(spectra * transfer, self.padded)
        return records[..., : self.sim.length]

    def scaled(self, records: Tensor) -> Tensor:
        """Records of the height to which noise is added."""
        return records / self.height(records)

    def height(self, records: Tensor) -> Tensor:
        """Mean long after the pulse over the nominal level, shape (..., pulses, 1)."""
        plateau = records[..., self.sim.plateau]
        over: Tensor = (
            plateau.mean(dim=-1, keepdim=True) / self.sim.moments.preparation.tail_level
        )
        return over

    def blocks(
        self,
        ways: Ways,
        functions: Functions,
        of: Callable[[int, Tensor, Tensor, Tensor], T],
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
        with torch.no_grad():
            transfer = response.transfer(self.padded).to(torch.complex64)
        of_transfer = ways.of_transfer.to(torch.complex64)[:, None]

        def one(first: int) -> list[T]:
            spectra = torch.from_numpy(self.sim.spectrum(response, first, BLOCK))
            rows = slice(first, first + len(spectra))
            clean, moved = self.records(spectra, transfer), self.records(spectra, of_transfer)
            if len(further := ways.of_pulses(rows)):
                changes = current_spectrum(further, self.padded, self.sim.dt_ns)
                moved = torch.cat([moved, self.records(changes, transfer)])
            heights = self.height(clean), self.height(moved)
            clean = clean / heights[0]
            found = []
            for draw in range(len(self.sim.noise.factor))[:draws]:
                noisy = clean + self.noise(draw, first, len(clean))
                at = self.readings.samples(noisy)
                parts, moving = self.readings.parts(noisy, at), self.readings.moving(noisy, at)
                of_moved = torch.func.vmap(partial(self.readings.parts, at=at))(moved)
                changes = of_moved - self.readings.parts(clean, at) * heights[1]
                slopes = self.readings.slopes(parts, moving, changes / heights[0])
                values = self.readings.read(parts)
                read: list[Any] = [Dual(*one) for one in zip(values, slopes, strict=True)]
                made = functions(Readings(read[0], read[1], NO_WEIGHTS))
                found.append(of(first, made.value, made.slopes, self.weights[rows]))
            return found

        blocks = in_threads(one, range(0, len(self.sim), BLOCK))
        return [part for block in blocks for part in block]

    def slopes(
        self, ways: Ways, functions: Functions, *, draws: int | None = None
    ) -> npt.NDArray[np.float64]:
        """Derivatives of the means of the functions, shape (functions, coordinates)."""

        def of(
            first: int, values: Tensor, moved: Tensor, weights: Tensor
        ) -> tuple[Tensor, float]:
            return (weights @ moved).double(), float(weights.sum())

        sums, n = zip(*self.blocks(ways, functions, of, draws=draws), strict=True)
        return np.asarray(torch.stack(sums).sum(dim=0).T / sum(n))

    def noise(self, draw: int, first: int, n: int) -> Tensor:
        """Noise of `n` pulses from the first one on, shape (n, samples)."""
        nothing = np.zeros((n, self.sim.length), np.float32)
        return torch.from_numpy(self.sim.noise.add(nothing, draw, first))
