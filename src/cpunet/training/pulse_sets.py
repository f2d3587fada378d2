"""Pulses of both sides with the noise of the data, as they are compared.

A fit compares many responses.  All of them have the same noise, drawn once, so that their
differences are those of the responses.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.fft

from cpunet.electronics.baseline_noise import BaselineNoise, require_energies
from cpunet.electronics.finishing import padding, record_length
from cpunet.kernels import kernel
from cpunet.networks.by_height import ByHeight
from cpunet.networks.response_layer import ElectronicsResponse, Spectrum, padded_length
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.loading import InputSet
from cpunet.recipes.schema import Recipe
from cpunet.training.aligned import Aligned, Floats, Frame, Samples, Values, read
from cpunet.training.energy_bands import (
    MIN_PULSES,
    EnergyBand,
    energy_bands,
    spectrum_weights,
)

MOST, IN_BAND = 4096, 1536  # pulses of a side that are compared, and of a band of a continuum
NOISES = 1000  # draws of noise that few pulses have, for a covariance
DRAWN = 8192  # pulses that give the slope of the tails
# Maximum number of noise traces, each twice as long as a record.  For more pulses,
# they share the traces, with other start samples and signs.
NOISE_TRACES = 4096
PLATEAU_NS = 1600.0  # after the window, over which the mean gives the height of a record
# Times in ns from the half height between which every sample is compared, shortest and longest
# stretches within and elsewhere, and samples compared per pulse at most.
DENSE_NS, FINEST_NS, COARSE_NS, FEWEST = (-1000.0, 3000.0), 8.0, 64.0, 1.3
# A pulse with another before it, or on its tail, as one that is collected late seems to be:
# height of its baseline, time from which the tail counts, and its deviation from the others in
# robust standard deviations, fewer than those of the quality cuts that the data have passed.
QUIET, TAIL_NS, FAR = 0.05, 1600.0, 5.0
MOSTLY = 0.8  # of the simulated pulses are single, unless they are far from the data

SINGLE = "single sites of the continuum"

Continuum = Callable[[], tuple[InputSet, InputSet]]
Rows = slice | Samples | npt.NDArray[np.bool_]


class Noise:
    """Noise for records of `length` samples of a set of pulses, the same at each use.

    The two draws of a pair are of opposite sign, so that the contribution of noise to a mean
    cancels.

    Attributes
    ----------
    traces
        For an energy of 1 keV, shape (traces, samples).
    trace, start, factor
        Trace, start sample, and sign divided by energy, for each draw and pulse; each of shape
        (draws, pulses).
    left, decay
        Pile-up tails for each record, shape (draws, pulses), and their decay over
        a record, shape (samples,); None for none.
    """

    left: FloatArray | None = None
    decay: FloatArray | None = None

    def __init__(
        self,
        noise: BaselineNoise,
        energy_kev: Values,
        length: int,
        pairs: int,
        rng: np.random.Generator,
    ) -> None:
        n = len(energy_kev)
        n_traces = min(NOISE_TRACES, n * pairs)
        self.traces = replace(noise, tails=None).draw(np.ones(n_traces), 2 * length, rng)
        # each trace is used before any is used again
        rounds = range(-(-n * pairs // n_traces))
        trace = np.concatenate([rng.permutation(n_traces) for _ in rounds])
        self.trace = np.repeat(trace[: n * pairs].reshape(pairs, n), 2, axis=0)
        sign = rng.choice((-1.0, 1.0), (pairs, n))
        self.start = np.repeat(rng.integers(0, length + 1, (pairs, n)), 2, axis=0)
        factor = np.stack([sign, -sign], axis=1).reshape(2 * pairs, n) / energy_kev
        self.factor = np.asarray(factor, np.float32)
        if (tails := noise.tails) is not None:
            self.left = np.stack([tails.factors(energy_kev, rng) for _ in range(2 * pairs)])
            self.decay = np.asarray(tails.decay(length), np.float32)

    def add(self, records: FloatArray, draw: int) -> FloatArray:
        """Records of the pulses with the noise of a draw."""
        noisy = np.empty(records.shape, np.float32)
        trace, start, factor = (each[draw] for each in (self.trace, self.start, self.factor))
        _add(records, self.traces, trace, start, factor, noisy)
        if self.left is not None and self.decay is not None:
            noisy += self.left[draw, :, np.newaxis] * self.decay
        return noisy


@kernel(error_model="numpy")
def _add(
    records: Any, traces: Any, trace: Any, start: Any, factor: Any, noisy: Any
) -> None:  # pragma: no cover - compiled
    """Add part of a noise trace to each record: index of the trace, start sample, factor."""
    for row in range(len(records)):
        drawn, first, scale = traces[trace[row]], start[row], factor[row]
        for i in range(records.shape[1]):
            noisy[row, i] = records[row, i] + scale * drawn[first + i]


class Sides:
    """Simulated pulses with their noise, and measured ones, of a band of energies.

    Parameters
    ----------
    sim
        Prepared simulated pulses.
    data
        Prepared measured pulses, shape (pulses, samples).
    noise
        Noise of the simulated pulses.
    recipe
        Recipe that matches a response, which says what is read.
    name, rows
        Name of the band, and rows of the simulated pulses in the set that they are of.

    Attributes
    ----------
    sim, current, charge
        Simulated pulses, shape (pulses, samples), and the same within records.
    data, data_view
        Measured pulses that are single, and their means over the stretches.
    left_out, sim_left_out
        Number of the other measured pulses, and of simulated ones, see `cut_like_data`.
    first, widths, time_ns
        First sample and samples of each stretch that is compared, and its middle in ns from the
        half height.
    by_height
        What the electronics do by the height of a pulse.
    """

    by_height: ByHeight | None = None
    sim_left_out = 0

    def __init__(
        self,
        sim: Pulses,
        data: FloatArray,
        noise: Noise,
        recipe: Recipe,
        name: str,
        rows: Samples,
    ) -> None:
        self.frame = frame = Frame(recipe.matching.training)
        # height of the plateau of a prepared pulse, to which the noise refers
        self.tail_level = recipe.preparation.tail_level
        self.noise, self.energy_kev, self.name, self.rows = noise, sim.energy_kev, name, rows
        self.before, self.behind = padding(frame.dt_ns)
        self.length = sim.length + self.before + self.behind
        self.padded = padded_length(self.length)
        self.take(sim.waveforms)
        every = read(data, frame)
        self.late = slice(frame.before + round(TAIL_NS / frame.dt_ns), None)
        late = every.pulses[:, self.late]
        self.middle = np.median(late, axis=0)
        self.spread = np.median(np.abs(late - self.middle), axis=0)
        self.widest = FAR * 1.4826 * np.median(np.abs(self.tails(every)), axis=0)
        single = self.single(every)
        self.data, self.left_out = every[single], int((~single).sum())
        self.divide()

    def __len__(self) -> int:
        return len(self.current)

    def take(self, sim: FloatArray) -> None:
        """Let these be the simulated pulses of the same events."""
        self.sim, inside = sim, slice(self.before, self.before + sim.shape[1])
        self.current = np.zeros((len(sim), self.length), np.float32)
        self.current[:, inside] = np.diff(sim, axis=1, prepend=np.float32(0))
        self.charge = self.current.cumsum(axis=1, dtype=np.float32)
        self.spectra = scipy.fft.rfft(self.current, self.padded)

    def divide(self) -> None:
        """Divide pulses into stretches; the fewer pulses, the longer stretches."""
        frame, most = self.frame, FEWEST * min(len(self), len(self.data))
        length = frame.before + frame.after
        fine, coarse = (max(1, round(ns / frame.dt_ns)) for ns in (FINEST_NS, COARSE_NS))
        while True:
            first, at = list[int](), 0
            while at < length:
                first.append(at)
                dense = DENSE_NS[0] <= (at - frame.before) * frame.dt_ns < DENSE_NS[1]
                at += fine if dense else max(fine, coarse)
            if len(first) <= most or fine > coarse:
                break
            fine *= 2
        self.first = np.array(first)
        self.widths = np.diff(np.append(self.first, length))
        middle = self.first + 0.5 * (self.widths - 1) - frame.before
        self.time_ns: Values = np.asarray(middle * frame.dt_ns)
        self.data_view = self.view(self.data.pulses)

    def entering(self, response: ElectronicsResponse) -> Sides:
        """The same pulses around a readout: drift stretched, and what acts by their height."""
        if response.drift is None and response.by_height is self.by_height:
            return self
        other = copy.copy(self)
        if response.drift is not None:
            other.take(response.drifted(self.sim))
        other.by_height = response.by_height
        return other

    def of(self, most: int) -> Sides:
        """The first pulses of both sides."""
        return self if most >= max(len(self), len(self.data)) else self.some(slice(most))

    def some(self, rows: slice) -> Sides:
        """Some pulses of both sides, in stretches of their own."""
        some = self.of_events(rows)
        some.data = self.data[rows]
        some.divide()
        return some

    def of_events(self, rows: Rows) -> Sides:
        """Some of the simulated pulses, and all measured ones."""
        some = copy.copy(self)
        for name in ("sim", "current", "charge", "spectra", "energy_kev", "rows"):
            setattr(some, name, getattr(self, name)[rows])
        some.noise = copy.copy(self.noise)
        for name in ("trace", "start", "factor"):
            of_rows = np.ascontiguousarray(getattr(self.noise, name)[:, rows])
            setattr(some.noise, name, of_rows)
        if self.noise.left is not None:
            some.noise.left = self.noise.left[:, rows]
        return some

    def tails(self, aligned: Aligned) -> Values:
        """Slope and RMS of each tail, less those of most pulses, shape (pulses, 2)."""
        deviation = (aligned.pulses[:, self.late] - self.middle) / self.spread
        slope = deviation @ np.linspace(-1.0, 1.0, deviation.shape[1])
        both = np.column_stack([slope, np.sqrt((deviation**2).mean(axis=1))])
        return np.asarray(both - np.median(both, axis=0))

    def single(self, aligned: Aligned) -> npt.NDArray[np.bool_]:
        """Which pulses have no other before them or on their tail, and are collected early."""
        base = aligned.pulses[:, : self.frame.before // 4].mean(axis=1)
        near = np.abs(self.tails(aligned)) < self.widest
        return np.asarray(near.all(axis=1) & (np.abs(base) < QUIET))

    def cut_like_data(self, response: ElectronicsResponse) -> Sides:
        """Without the simulated pulses that are not single behind a response."""
        drawn = self.noisy(*self.translated(response.transfer(self.padded)))
        single = np.all([self.single(draw) for draw in drawn], axis=0)
        if single.mean() <= MOSTLY:
            return self
        others = self.of_events(single)
        others.sim_left_out = int((~single).sum())
        return others

    def view(self, aligned: Floats) -> Floats:
        """Means of aligned pulses over the stretches, shape (pulses, stretches)."""
        sums = np.add.reduceat(aligned, self.first, axis=1)
        return np.asarray(sums / self.widths.astype(sums.dtype))

    def translated(self, transfer: Spectrum) -> tuple[FloatArray, Floats]:
        """Noise-free records of prepared height, and the height of each before."""
        spectra = self.spectra * transfer.astype(np.complex64)
        records = scipy.fft.irfft(spectra, self.padded, overwrite_x=True)[:, : self.length]
        plateau = slice(-self.behind, round(PLATEAU_NS / self.frame.dt_ns) - self.behind)
        heights = records[:, plateau].mean(axis=1) / np.float32(self.tail_level)
        return np.asarray(records / heights[:, np.newaxis], np.float32), heights

    def changed(self, sim: FloatArray, transfer: Spectrum, heights: Floats) -> FloatArray:
        """What a change of the simulated pulses does to the records."""
        change = np.diff(sim, axis=1, prepend=np.float32(0))
        spectra = scipy.fft.rfft(change, self.padded) * transfer.astype(np.complex64)
        records = scipy.fft.irfft(spectra, self.padded, overwrite_x=True)
        inside = np.roll(records, self.before, axis=1)[:, : self.length]
        return np.asarray(inside / heights[:, np.newaxis], np.float32)

    def noisy(self, clean: FloatArray, heights: Floats) -> list[Aligned]:
        """Records with each draw of the noise, read."""
        return [self.read(clean, heights, draw) for draw in range(len(self.noise.factor))]

    def read(self, clean: FloatArray, heights: Floats, draw: int | None = None) -> Aligned:
        """Records of prepared height, with a draw of noise or none, behind the electronics."""
        records = clean if draw is None else self.noise.add(clean, draw)
        if self.by_height is not None:
            height = heights[:, np.newaxis].astype(np.float32)
            charge, noise = clean * height, (records - clean) * height
            records = np.asarray(self.by_height(charge, self.energy_kev, noise), np.float32)
        return read(records, self.frame)


@dataclass(eq=False)
class PulseSets:
    """Both sides in bands of energy, and representative subsets of them.

    Parameters
    ----------
    sim, data
        Prepared pulses with their energies.
    noise
        Noise of the data's baselines, with their pile-up tails.
    recipe
        Recipe that matches a response.
    rng
        Random generator that chooses the subsets and draws the noise.
    continuum
        Reads the pulses of both sides away from all lines, for `single_sites`.

    Attributes
    ----------
    bands
        Bands of energy, with their pulses of both sides in random order.
    tail_slope
        Median slope per sample of the logarithm of the data's tails.

    Raises
    ------
    CpunetError
        If the pulses are too few, or an energy is missing.
    """

    sim: Pulses
    data: Pulses
    noise: BaselineNoise
    recipe: Recipe
    rng: np.random.Generator
    continuum: Continuum | None = None

    def __post_init__(self) -> None:
        require_energies(self.sim.energy_kev)
        energies, self.bands = (self.sim.energy_kev, self.data.energy_kev), list[EnergyBand]()
        for name, sim, data, weights in energy_bands(*energies, self.recipe.peaks):
            # in random order, so that any first part is representative
            order, other = (self.rng.permutation(len(side)) for side in (sim, data))
            self.bands.append(EnergyBand(name, sim[order], data[other], weights[order]))
        samples = self.recipe.preparation.decay_fit_samples
        lever = np.arange(samples) - 0.5 * (samples - 1)
        tails = self.data.waveforms[spread(len(self.data), DRAWN), -samples:]
        slopes = np.log(np.maximum(tails, 1e-3)) @ (lever / (lever @ lever))
        self.tail_slope = float(np.nanmedian(slopes))

    def sides(self) -> list[Sides]:
        """Pulses of both sides in each band, for the comparison at every sample."""
        return [self._sides(self.sim, self.data, band) for band in self.bands]

    def single_sites(self) -> list[Sides]:
        """Pulses of the continuum, whose single sites are compared; none if they are few."""
        if self.continuum is None:
            return []
        sim, data = (side.prepared.pulses for side in self.continuum())
        rows = [self.rng.permutation(len(side))[:MOST] for side in (sim, data)]
        if min(map(len, rows)) < MIN_PULSES:
            return []
        weights = spectrum_weights(sim.energy_kev[rows[0]], data.energy_kev[rows[1]])
        return [self._sides(sim, data, EnergyBand(SINGLE, rows[0], rows[1], weights))]

    def _sides(self, sim: Pulses, data: Pulses, band: EnergyBand) -> Sides:
        most = MOST if band.name in {SINGLE, *self.recipe.peaks} else IN_BAND
        rows, weights = band.sim[:most], band.weights[:most]
        if np.ptp(weights) > 0:  # each as often as its weight says, to a whole number
            share = np.cumsum(weights) / weights.sum()
            rows = rows[np.searchsorted(share, (np.arange(len(rows)) + 0.5) / len(rows))]
        sim, measured = sim[rows], data.waveforms[band.data[:most]]
        length, pairs = record_length(sim.length, sim.dt_ns), max(1, round(NOISES / len(sim)))
        noise = Noise(self.noise, sim.energy_kev, length, pairs, self.rng)
        finite = np.isfinite(measured).all(axis=1)
        return Sides(sim, measured[finite], noise, self.recipe, band.name, rows)


def spread(n: int, most: int) -> Samples:
    """Samples of at most `most` of `n` pulses, spread over all: files can be in any order."""
    return np.linspace(0, n - 1, min(n, most)).astype(np.intp)
