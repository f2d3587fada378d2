"""Simulated pulses after a response and with noise, read block by block on all cores.

A fit evaluates the means of the same functions for many responses.  The noise is therefore
drawn once, so that responses are compared with the same noise, and only sums over the pulses
are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import scipy.fft

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_pile_up import DrawnTails
from cpunet.kernels import threads
from cpunet.networks.response_layer import (
    DriftClock,
    ElectronicsResponse,
    padded_length,
    padding,
    record_length,
)
from cpunet.pulses.container import FloatArray
from cpunet.training._record_kernels import add_noise
from cpunet.training.moments import BLOCK, Moments, Readings, Rows, Values

DELAY_NS = 1600.0  # maximum delay of the half maximum by the response
PLATEAU_NS = 1600.0  # after the window, over which the mean gives the height of a record
# Maximum number of noise traces, each twice as long as a record.  If there are more pulses,
# they share the traces, with other start samples and signs.
NOISE_TRACES = 4096
SPECTRA_BYTES = 2**27  # of pulse spectra that are cached between responses
# Maximum fraction of translated pulses to remove by the data's range of tail slopes.  If it is
# larger, none are removed: the response is still far off.
MAX_CUT = 0.2

# Weighted sums over a block of pulses; sums over pulses, and the total weight of these.
Summed = Callable[[Readings], tuple[Values, ...]]
Total = tuple[tuple[Values, ...], float]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise for a set of pulses, the same at each use.

    Parameters
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

    traces: FloatArray
    trace: npt.NDArray[np.intp]
    start: npt.NDArray[np.intp]
    factor: FloatArray
    left: FloatArray | None = None
    decay: FloatArray | None = None

    @classmethod
    def draw(
        cls,
        noise: BaselineNoise,
        energy_kev: Values,
        length: int,
        draws: int,
        rng: np.random.Generator,
        tails: DrawnTails | None = None,
    ) -> Noise:
        """Draw noise for records of `length` samples.

        Every second draw is the one before it with opposite sign, so that the contribution of
        noise to a mean cancels.
        """
        n, pairs = len(energy_kev), -(-draws // 2)
        kept = min(NOISE_TRACES, n * pairs)
        traces = noise.draw(np.ones(kept), 2 * length, rng)
        # each trace is used before any is used again
        trace = np.concatenate([rng.permutation(kept) for _ in range(-(-n * pairs // kept))])
        sign = rng.choice((-1.0, 1.0), (pairs, n))
        drawn = cls(
            traces,
            np.repeat(trace[: n * pairs].reshape(pairs, n), 2, axis=0)[:draws],
            np.repeat(rng.integers(0, length + 1, (pairs, n)), 2, axis=0)[:draws],
            np.asarray(
                np.stack([sign, -sign], axis=1).reshape(2 * pairs, n)[:draws] / energy_kev,
                np.float32,
            ),
        )
        if tails is None:
            return drawn
        left = np.stack([tails.factors(energy_kev, rng) for _ in range(draws)])
        return replace(drawn, left=left, decay=np.asarray(tails.decay(length), np.float32))

    def of(self, rows: Rows | slice) -> Noise:
        """Noise of some of the pulses."""
        return replace(
            self,
            trace=np.ascontiguousarray(self.trace[:, rows]),
            start=np.ascontiguousarray(self.start[:, rows]),
            factor=np.ascontiguousarray(self.factor[:, rows]),
            left=None if self.left is None else self.left[:, rows],
        )

    def add(self, records: FloatArray, draw: int, first: int) -> FloatArray:
        """Records of the pulses from `first` on, with the noise of a draw."""
        noisy = np.empty(records.shape, np.float32)
        rows = slice(first, first + len(records))
        trace, start, factor = (
            each[draw, rows] for each in (self.trace, self.start, self.factor)
        )
        add_noise(records, self.traces, trace, start, factor, noisy)
        if self.left is not None and self.decay is not None:
            noisy += self.left[draw, rows, np.newaxis] * self.decay
        return noisy


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads for blocks, which are kept: to start them takes a tenth of the time of these."""
    return ThreadPoolExecutor(threads)


def in_threads(of: Callable[[int], T], starts: range) -> list[T]:
    """What is made of blocks of pulses, in their order, whichever thread finishes first."""
    if (several := threads()) == 1 or len(starts) == 1:
        return [of(first) for first in starts]
    return list(_pool(several).map(of, starts))


@dataclass(frozen=True, eq=False)
class SimulatedSide:
    """A set of simulated pulses, the noise they get, and the functions they are compared by.

    Parameters
    ----------
    sim
        Prepared simulated pulses, shape (pulses, samples).
    noise
        Noise of their records.
    moments
        Moments defined by the data that they are compared with.
    weights
        Weights of the pulses, shape (pulses,).
    """

    sim: FloatArray
    noise: Noise
    moments: Moments
    weights: Values
    # of each block, first pulse and number, for one stretch of the drift
    _spectra: dict[tuple[int, int], npt.NDArray[np.complex64]] = field(
        default_factory=dict, init=False, repr=False
    )
    _stretch: list[float] = field(default_factory=list, init=False, repr=False)

    def __len__(self) -> int:
        return len(self.sim)

    @property
    def length(self) -> int:
        """Samples of a record."""
        return record_length(self.sim.shape[1], self.dt_ns)

    @property
    def dt_ns(self) -> float:
        """Sampling period in ns."""
        return self.moments.dt_ns

    @property
    def plateau(self) -> slice:
        """Samples of a record whose mean gives its height."""
        _, after = padding(self.dt_ns)
        return slice(-after, round(PLATEAU_NS / self.dt_ns) - after)

    @property
    def last(self) -> int:
        """Sample of a record after all half maxima."""
        late = round(DELAY_NS / self.dt_ns)
        return padding(self.dt_ns)[0] + self.moments.preparation.samples_before + late

    def of(self, rows: Rows | slice) -> SimulatedSide:
        """Some of the pulses, with their noise."""
        noise = self.noise.of(rows)
        return SimulatedSide(self.sim[rows], noise, self.moments, self.weights[rows])

    def sums(
        self,
        response: ElectronicsResponse,
        of: Summed,
        *,
        cut: bool = True,
        draws: int | None = None,
    ) -> Total:
        """Sums over all pulses and draws of noise, and the weight of the pulses used.

        Parameters
        ----------
        response
            Response applied to the pulses.
        of
            Function for the weighted sums over one block of pulses; called in several threads.
        cut
            Whether to exclude pulses with tail slopes outside the range of the data, unless
            there are too many of them among all (`MAX_CUT`).
        draws
            Number of draws to use; None for all.

        Returns
        -------
        tuple
            The sums, and the total weight of the pulses in them.
        """
        return _added(self.sums_of_blocks(response, of, cut=cut, draws=draws))

    def sums_of_blocks(
        self,
        response: ElectronicsResponse,
        of: Summed,
        *,
        size: int = BLOCK,
        cut: bool = True,
        draws: int | None = None,
    ) -> list[Total]:
        """Same as `sums`, for each block of `size` pulses in their order."""
        padded = padded_length(self.length)
        transfer = response.transfer(padded).astype(np.complex64)
        self.forget_unless(response)

        def one(first: int) -> tuple[list[Total], list[Total], int]:
            """Totals of each draw, within the data's range and beyond it, and pulses beyond."""
            within, outside, n = [], [], 0
            spectrum = self.spectrum(response, first, size) * transfer
            records = scipy.fft.irfft(spectrum, padded, overwrite_x=True)[:, : self.length]
            top = records[:, self.plateau]
            records *= self.moments.preparation.tail_level / top.mean(axis=1, keepdims=True)
            weights = self.weights[first : first + size]
            for draw in range(len(self.noise.factor))[:draws]:
                noisy = self.noise.add(records, draw, first)
                readings, beyond = self.moments.read(noisy, self.last, weights)
                if cut and beyond.any():
                    others, readings = readings[beyond], readings[~beyond]
                    outside.append((of(others), float(others.weights.sum())))
                    n += len(others)
                within.append((of(readings), float(readings.weights.sum())))
            return within, outside, n

        blocks = in_threads(one, range(0, len(self), size))
        # decided for all pulses together, so that it does not depend on the blocks
        n_read = len(self) * len(range(len(self.noise.factor))[:draws])
        exclude = sum(n for _, _, n in blocks) < MAX_CUT * n_read
        return [
            _added(within if exclude else within + outside) for within, outside, _ in blocks
        ]

    def of_each(
        self, response: ElectronicsResponse, of: Callable[[Readings], Values]
    ) -> Values:
        """Functions of each pulse, means over the draws, shape (pulses, functions)."""
        blocks = self.sums_of_blocks(response, lambda readings: (of(readings),), cut=False)
        sums = np.concatenate([functions for (functions,), _ in blocks])
        return np.asarray(sums / len(self.noise.factor))

    def forget_unless(self, response: ElectronicsResponse) -> None:
        """Forget the spectra of another stretch of the drift than that of a response."""
        drift = response.drift
        stretch = drift.stretch.tolist() if isinstance(drift, DriftClock) else []
        if stretch != self._stretch:
            self._spectra.clear()
            self._stretch[:] = stretch

    def spectrum(
        self, response: ElectronicsResponse, first: int, size: int
    ) -> npt.NDArray[np.complex64]:
        """Fourier transform of the currents of one block, cached up to `SPECTRA_BYTES`."""
        sim = self.sim[first : first + size]
        if (kept := self._spectra.get((first, len(sim)))) is not None:
            return kept
        if response.drift is not None:
            sim = response.drifted(sim)
        current = np.zeros((len(sim), self.length), np.float32)
        before, after = padding(self.dt_ns)
        current[:, before] = sim[:, 0]
        np.subtract(sim[:, 1:], sim[:, :-1], out=current[:, before + 1 : -after])
        spectrum: npt.NDArray[np.complex64] = scipy.fft.rfft(
            current, padded_length(self.length)
        )
        if (first + len(sim)) * spectrum[0].nbytes <= SPECTRA_BYTES:
            self._spectra[first, len(sim)] = spectrum
        return spectrum


def _added(parts: Sequence[Total]) -> Total:
    """Sum of totals, in their order."""
    sums = zip(*(found for found, _ in parts), strict=True)
    return tuple(np.sum(np.stack(one), axis=0) for one in sums), sum(n for _, n in parts)
