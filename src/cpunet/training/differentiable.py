"""The moments of translated pulses with exact derivatives.

A fit of many parameters, and a network, need derivatives that differences do not give: noise
moves a half maximum by a sample here and there, and each such jump is as large as what is
looked for.  Here the samples at which a record is read are found first, by the rules of
`cpunet.training._record_kernels` and without derivatives.  What is read there is linear in a
record, so its derivatives are read alike; what follows from it is in the graph.  Where a window
moves with the half maximum, by whole samples, the derivative is that of its mean position.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cpunet.networks.generators import stretch
from cpunet.networks.learned_response import StepResponse
from cpunet.networks.response_layer import PADDING_AFTER, Readout, padded_length
from cpunet.pulses.parameters import current_amplitude_kernel
from cpunet.training.moments import Moments
from cpunet.training.translated import PLATEAU, SimulatedSide

BLOCK = 128  # pulses at a time: each has a record for every parameter
AGAIN = 20  # samples after the half maximum from which it is searched for again

# Functions of each pulse, from its linear readings and the logarithm of its current amplitude.
Functions = Callable[[Tensor, Tensor], Tensor]


class Samples(NamedTuple):
    """Samples at which records are read, each of shape (pulses,)."""

    level: Tensor  # half maximum that baseline and level refer to
    half: Tensor  # half maximum of the normalised record
    tail: Tensor  # start of the tail
    steepest: Tensor  # centre of the current amplitude, and its phase
    phase: Tensor


class DifferentiableReadings:
    """`Moments.read` and `Moments.functions` in the graph of PyTorch.

    Parameters
    ----------
    moments
        Moments defined by the data.
    last
        Sample after all half maxima.
    """

    def __init__(self, moments: Moments, last: int) -> None:
        self.moments, self.config = moments, moments.config
        self.window = w = moments.window(last)
        self.matrix = torch.from_numpy(moments.quantities)
        self.offset = torch.zeros(self.matrix.shape[1])
        self.offset[-len(moments.offset) :] = torch.from_numpy(moments.offset)
        self.centres, self.spreads, self.bins, self.bin_widths = (
            torch.from_numpy(values).float()
            for values in (
                moments.centres,
                moments.spreads,
                moments.amplitude_centres,
                moments.amplitude_widths,
            )
        )
        self.weights = torch.from_numpy(np.asarray(current_amplitude_kernel(), np.float32))
        lever = torch.arange(w.fit_samples) - 0.5 * (w.fit_samples - 1)
        self.lever = lever / (lever @ lever)
        n = self.matrix.shape[1]
        self.sizes = [2, 2, 2, 2, 2, n, n, w.fit_samples + 1]

    def __call__(self, records: Tensor) -> tuple[Tensor, Tensor]:
        """Read noisy records (pulses, samples): linear readings, and log current amplitudes."""
        return self.read(self.parts(records, self.samples(records.detach())))

    def parts(self, records: Tensor, at: Samples) -> Tensor:
        """All of the records that is read, shape (pulses, parts); it is linear in them.

        Of what is read between two samples, both are there.
        """
        w, half = self.window, self.weights.shape[1] // 2
        base = stretch(records, at.level, -w.base_first, -w.base_stop + 1)
        top = stretch(records, at.level, w.after - w.level_samples, w.after + 1)
        means = [
            torch.stack([x[:, :-1].mean(dim=1), (x[:, -1] - x[:, 0]) / (x.shape[1] - 1)], dim=1)
            for x in (base, top)
        ]
        halves = [stretch(records, sample, 0, 2) for sample in (at.level, at.half)]
        centre = at.half - w.before + at.steepest
        current = torch.diff(stretch(records, centre, -half, half + 3)).unfold(1, 2, 1)
        steepest = (current * self.weights[at.phase][:, :, None]).sum(dim=1)
        around = stretch(records, at.half, -w.before, w.after + 1)
        quantities = [around[:, :-1] @ self.matrix, around[:, 1:] @ self.matrix]
        tail = stretch(records, at.tail, 0, w.fit_samples + 1)
        return torch.cat([*means, *halves, steepest, *quantities, tail], dim=1)

    def read(self, parts: Tensor) -> tuple[Tensor, Tensor]:
        """Linear readings, and log current amplitudes, of the parts of records."""
        base, top, first, half, current, early, late, tail = torch.split(parts, self.sizes, 1)
        # 0, but has the derivative of the time of the half maximum
        moved = self._time(self._normalised(first, base[:, 0], top[:, 0]))
        moved = moved - moved.detach()
        zero, level = ((x[:, 0] + moved * x[:, 1]) for x in (base, top))
        time = self._time(self._normalised(half, zero, level))[:, None]
        linear = torch.lerp(early, late, time) - zero[:, None] * self.matrix.sum(dim=0)
        scale = (self.window.tail_level / (level - zero))[:, None]
        logs = self._normalised(tail, zero, level).clamp_min(1e-3).log()
        slope = logs[:, :-1] @ self.lever
        slope = slope + moved * (logs[:, 1:] @ self.lever - slope)
        amplitude = torch.lerp(current[:, :1], current[:, 1:], time) * scale
        whole = torch.cat([linear * scale - self.offset, slope[:, None]], dim=1)
        return (whole - self.centres) / self.spreads, amplitude[:, 0].clamp_min(1e-4).log()

    def functions(self, linear: Tensor, amplitude: Tensor, clip: float | None = None) -> Tensor:
        """Functions of each pulse as `Moments.functions`, shape (pulses, moments)."""
        density = _density(amplitude, self.bins, self.bin_widths)
        if self.moments.balance is not None:
            return density @ torch.from_numpy(self.moments.balance).float()
        config, limit = self.config, clip or self.config.clip
        linear = linear.clamp(-limit, limit)
        first = len(config.segments) - 1
        squared = torch.cat([linear[:, first : first + config.squares], linear[:, -1:]], dim=1)
        return torch.cat([linear, squared.square(), density], dim=1)

    def conditional(self, centres: Tensor, widths: Tensor) -> Functions:
        """Functions as `ConditionalFunctions`, for its bins."""

        def functions(linear: Tensor, amplitude: Tensor) -> Tensor:
            values = self.functions(linear, amplitude)
            first = len(self.config.segments) - 1
            components = values[:, first : first + self.config.components]
            bins = _density(amplitude, centres, widths)
            both = components[:, :, None] * bins[:, None, :]
            return torch.cat([values, bins, both.flatten(1)], dim=1)

        return functions

    def samples(self, records: Tensor) -> Samples:
        """Samples at which noisy records are read."""
        w = self.window
        first = self._crossing(records, torch.full_like(records[:, 0], w.last))
        level = self._crossing(self._about(records, first), first + AGAIN)
        normal = self._about(records, level)
        half = self._crossing(normal, level + AGAIN)
        begin = w.last - w.align_before
        top = normal[:, begin : w.last + w.align_after]
        before = torch.arange(top.shape[1]) < top.argmax(dim=1, keepdim=True)
        below = (top < w.align_fraction * top.amax(dim=1, keepdim=True)) & before
        tail = begin + _last(below) + 1 + w.align_after - w.fit_samples
        around = stretch(normal, half, -w.before, w.after + 1)
        time = self._time(stretch(normal, half, 0, 2))[:, None]
        current = torch.diff(torch.lerp(around[:, :-1], around[:, 1:], time))
        from_sample = max(w.before - w.edge, 0)
        steepest = from_sample + current[:, from_sample : w.before + w.edge].argmax(dim=1)
        near, width = w.edge // 3, self.weights.shape[1]
        around = stretch(current, steepest, -near - width // 2, near + width // 2 + 1)
        best = (around.unfold(1, width, 1) @ self.weights.T).flatten(1).argmax(dim=1)
        phases = len(self.weights)
        centre = steepest - near + torch.div(best, phases, rounding_mode="floor")
        return Samples(level, half, tail, centre, best % phases)

    def _crossing(self, records: Tensor, last: Tensor) -> Tensor:
        """Sample before the last upward crossing of the half height before `last`."""
        low = records[:, :-1]
        index = torch.arange(low.shape[1])
        return _last((low < self.window.level) & (index < last[:, None])).clamp_min(0)

    def _about(self, records: Tensor, sample: Tensor) -> Tensor:
        """Records with baseline 0 and nominal level about their half maxima."""
        w = self.window
        zero = stretch(records, sample, -w.base_first, -w.base_stop).mean(dim=1)
        level = stretch(records, sample, w.after - w.level_samples, w.after).mean(dim=1)
        return self._normalised(records, zero, level)

    def _normalised(self, values: Tensor, zero: Tensor, level: Tensor) -> Tensor:
        scale = self.window.tail_level / (level - zero)
        return (values - zero[:, None]) * scale[:, None]

    def _time(self, pair: Tensor) -> Tensor:
        """Time of the half maximum after the first of two samples."""
        low, high = pair.unbind(dim=1)
        return (self.window.level - low) / (high - low).clamp_min(1e-6)


class DifferentiableSet:
    """A set of simulated pulses whose functions have derivatives in the step response.

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
        """Mean long after the pulse over the nominal level, shape (pulses, 1)."""
        plateau = records[:, -PADDING_AFTER : PLATEAU - PADDING_AFTER].mean(dim=1, keepdim=True)
        return plateau / self.sim.moments.preparation.tail_level

    @torch.no_grad()
    def values(self, response: Readout) -> npt.NDArray[np.float64]:
        """Moments' functions of each pulse, means over the draws, shape (pulses, moments)."""
        transfer = response.transfer(self.padded).to(torch.complex64)
        out = []
        for first in range(0, len(self.sim), BLOCK):
            spectra = torch.from_numpy(self.sim.spectrum(response, first, BLOCK))
            clean = self.scaled(self.records(spectra, transfer))
            draws = [
                self.readings.functions(
                    *self.readings(clean + self.noise(d, first, len(clean)))
                )
                for d in range(len(self.sim.noise.factor))
            ]
            out.append(torch.stack(draws).mean(dim=0))
        return torch.cat(out).double().numpy()

    def blocks(
        self, response: StepResponse, functions: Functions, *, draws: int | None = None
    ) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
        """Functions of each pulse and their derivatives, block by block, draw by draw.

        Yields
        ------
        tuple
            First pulse; functions (pulses, functions); derivatives (coordinates, pulses,
            functions); weights of the pulses.
        """
        with torch.no_grad():
            transfer = response.transfer(self.padded).to(torch.complex64)
        slopes = response.transfer_slopes(self.padded).to(torch.complex64)[:, None]
        for first in range(0, len(self.sim), BLOCK):
            spectra = torch.from_numpy(self.sim.spectrum(response, first, BLOCK))
            clean, moved = self.records(spectra, transfer), self.records(spectra, slopes)
            heights = self.height(clean), torch.func.vmap(self.height)(moved)
            for draw in range(len(self.sim.noise.factor))[:draws]:
                noise = self.noise(draw, first, len(clean))
                at = self.readings.samples(clean / heights[0] + noise)
                parts = partial(self.readings.parts, at=at)
                added = parts(noise)

                def of(own: Tensor, height: Tensor, added: Tensor = added) -> Tensor:
                    return functions(*self.readings.read(own / height + added))

                along: Any = partial(torch.func.jvp, of, (parts(clean), heights[0]))
                tangents = torch.func.vmap(parts)(moved), heights[1]
                # the values are the same along all directions
                values, columns = torch.func.vmap(along, out_dims=(None, 0))(tangents)  # type: ignore[arg-type]
                yield first, values, columns, self.weights[first : first + BLOCK]

    def noise(self, draw: int, first: int, n: int) -> Tensor:
        """Noise of `n` pulses from the first one on, shape (n, samples)."""
        nothing = np.zeros((n, self.sim.length), np.float32)
        return torch.from_numpy(self.sim.noise.add(nothing, draw, first))


def _last(where: Tensor) -> Tensor:
    """Last sample of each row for which a condition holds; -1 for none."""
    return (where * torch.arange(1, where.shape[1] + 1)).amax(dim=1) - 1


def _density(log_amplitude: Tensor, centres: Tensor, widths: Tensor) -> Tensor:
    return torch.exp(-0.5 * ((log_amplitude[:, None] - centres) / widths).square())
