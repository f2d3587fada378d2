r"""Two unpaired sets of pulses compared at every sample, in slices by rank.

What all pulses share, as a ringing of the readout, is seen as precisely as noise permits; what
differs from pulse to pulse, only as precisely as the number of pulses does.  The covariance of
a difference of means therefore has two parts,

.. math:: C = S \left(\frac{1}{n_s} + \frac{1}{n_d}\right) + N \left(\frac{1}{n_d} + r\right),

the shapes' :math:`S` from the simulation without noise and the noise's :math:`N`; r is what
draws of opposite sign leave of the simulated noise.  Compared are

* the means of every sample in slices by rank of the current amplitude, and of the rise from 5
  to 50 %.  Slices are ranks of each side, so they are equally full however much the sides
  differ.  Means are those of bounded functions, :math:`w \tanh((A - m) / w)`, which rare
  pulses do not move;
* the quantiles of both, which say what a rank means.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.linalg

from cpunet.electronics.finishing import padding
from cpunet.networks.by_height import ByHeight
from cpunet.networks.response_layer import ElectronicsResponse, padded_length
from cpunet.pulses.container import FloatArray
from cpunet.training.aligned import Aligned, Floats, Frame, Samples, Values, read
from cpunet.training.drawn_noise import Noise

Spectrum = npt.NDArray[np.complexfloating[Any, Any]]
# Derivatives of aligned pulses, given the heights of their records before, in coordinates of
# whatever moves these.
Moved = Callable[["Sides", Aligned, Floats], Any]

MOST = 4096  # pulses of each side that are compared
PLATEAU_NS = 1600.0  # after the window, over which the mean gives the height of a record
# Times in ns from the half height between which every sample is compared, shortest and longest
# stretches within and elsewhere, and samples compared per pulse at most.
DENSE_NS, FINEST_NS, COARSE_NS, FEWEST = (-1000.0, 3000.0), 8.0, 64.0, 1.3
# Centres of the slices as ranks of either side.  The highest amplitudes are single sites, which
# differ least in shape.
AMPLITUDE, RISE = "log_amplitude", "rise"
RANKS = {
    AMPLITUDE: np.array([0.03, 0.15, 0.3, 0.45, 0.58, 0.69, 0.78, 0.85, 0.9, 0.94, 0.98]),
    RISE: np.linspace(0.02, 0.98, 8),
}
QUANTILES = np.r_[np.linspace(0.01, 0.95, 13), 0.97, 0.985, 0.995]
_ODDS = QUANTILES / (1 - QUANTILES)
CORRELATION = np.sqrt(np.minimum.outer(_ODDS, _ODDS) / np.maximum.outer(_ODDS, _ODDS))
NONE = np.empty((0, 0))  # derivatives
POOLED = 0.5  # of the shapes' covariance, taken from all slices
# A measured pulse with another before it, or on its tail: height of its baseline, time from
# which the tail counts, and its RMS in units of the median.
QUIET, TAIL_NS, LATE_RMS = 0.05, 2400.0, 4.0


class Sides:
    """Simulated pulses with their noise, and measured ones, of a band of energies.

    Parameters
    ----------
    sim, data
        Prepared pulses, shape (pulses, samples).
    noise
        Noise of the simulated pulses.
    frame
        What is read.
    tail_level
        Height of the plateau of a prepared pulse, which the noise refers to.
    energy_kev
        Energies of the simulated pulses.
    rows
        Their rows in the set that they were taken from.

    Attributes
    ----------
    current, charge
        Of the simulated pulses within records.
    data, data_view
        Measured pulses that are single, and their means over the stretches.
    first, widths, time_ns
        First sample and samples of each stretch that is compared, and its middle in ns from the
        half height.
    left_out
        Number of the others.
    by_height
        What the electronics do by the height of a pulse.
    """

    by_height: ByHeight | None = None

    def __init__(
        self,
        sim: FloatArray,
        data: FloatArray,
        noise: Noise,
        frame: Frame,
        tail_level: float,
        energy_kev: Values,
        rows: Samples,
    ) -> None:
        self.frame, self.noise, self.tail_level = frame, noise, tail_level
        self.energy_kev, self.rows = energy_kev, rows
        self.before, self.behind = padding(frame.dt_ns)
        self.length = sim.shape[1] + self.before + self.behind
        self.padded = padded_length(self.length)
        self.take(sim)
        self.data = read(data, frame)
        late = self.data.pulses[:, self._late]
        self.middle = np.median(late, axis=0)
        self.spread = np.median(np.abs(late - self.middle), axis=0)
        self.widest = LATE_RMS * float(np.median(self._late_rms(self.data)))
        single = self.single(self.data)
        self.data, self.left_out = self.data[single], int((~single).sum())
        self.divide()

    def take(self, sim: FloatArray) -> None:
        """Let these be the simulated pulses."""
        self.sim, inside = sim, slice(self.before, self.before + sim.shape[1])
        self.current = np.zeros((len(sim), self.length), np.float32)
        self.current[:, inside] = np.diff(sim, axis=1, prepend=np.float32(0))
        self.charge = self.current.cumsum(axis=1, dtype=np.float32)
        self.spectra = scipy.fft.rfft(self.current, self.padded)

    def divide(self) -> None:
        """Divide pulses into stretches; the fewer pulses, the longer stretches."""
        frame, most = self.frame, FEWEST * min(len(self), len(self.data))
        fine, coarse = (max(1, round(ns / frame.dt_ns)) for ns in (FINEST_NS, COARSE_NS))
        while True:
            first, at = list[int](), 0
            while at < frame.length:
                first.append(at)
                dense = DENSE_NS[0] <= (at - frame.before) * frame.dt_ns < DENSE_NS[1]
                at += fine if dense else max(fine, coarse)
            if len(first) <= most or fine > coarse:
                break
            fine *= 2
        self.first = np.array(first)
        self.widths = np.diff(np.append(self.first, frame.length))
        middle = self.first + 0.5 * (self.widths - 1) - frame.before
        self.time_ns: Values = np.asarray(middle * frame.dt_ns)
        self.data_view = self.view(self.data.pulses)

    def __len__(self) -> int:
        return len(self.current)

    def entering(self, response: ElectronicsResponse) -> Sides:
        """The same pulses around a readout: drift stretched, and what acts by their height."""
        if response.drift is None and response.by_height is self.by_height:
            return self
        drift = response.drift
        other = copy.copy(self) if drift is None else self.taking(response.drifted(self.sim))
        other.by_height = response.by_height
        return other

    def taking(self, sim: FloatArray) -> Sides:
        """The same with other simulated pulses of the same events."""
        other = copy.copy(self)
        other.take(sim)
        return other

    def of(self, most: int) -> Sides:
        """The first pulses of both sides."""
        if most >= max(len(self), len(self.data)):
            return self
        return self.some(slice(most))

    def some(self, rows: slice) -> Sides:
        """Some pulses of both sides, in stretches of their own."""
        some = self.of_events(rows)
        some.data = self.data[rows]
        some.divide()
        return some

    def of_events(self, rows: slice | Samples | npt.NDArray[np.bool_]) -> Sides:
        """Some of the simulated pulses, and all measured ones."""
        some = copy.copy(self)
        some.sim, some.current, some.charge, some.spectra = (
            part[rows] for part in (self.sim, self.current, self.charge, self.spectra)
        )
        some.energy_kev, some.rows = self.energy_kev[rows], self.rows[rows]
        some.noise = self.noise.of(rows)
        return some

    @property
    def _late(self) -> slice:
        return slice(self.frame.before + round(TAIL_NS / self.frame.dt_ns), None)

    def _late_rms(self, aligned: Aligned) -> Values:
        deviation = (aligned.pulses[:, self._late] - self.middle) / self.spread
        return np.asarray(np.sqrt((deviation**2).mean(axis=1)))

    def single(self, aligned: Aligned) -> npt.NDArray[np.bool_]:
        """Which pulses have no other before them or on their tail."""
        base = aligned.pulses[:, : self.frame.before // 4].mean(axis=1)
        quiet: npt.NDArray[np.bool_] = np.abs(base) < QUIET
        return quiet & (self._late_rms(aligned) < self.widest)

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
        draws = range(len(self.noise.factor))
        return [self.read(clean, heights, draw) for draw in draws]

    def read(self, clean: FloatArray, heights: Floats, draw: int | None = None) -> Aligned:
        """Records of prepared height, with a draw of noise or none, behind the electronics."""
        records = clean if draw is None else self.noise.add(clean, draw)
        if self.by_height is not None:
            height = heights[:, np.newaxis].astype(np.float32)
            charge, noise = clean * height, (records - clean) * height
            records = np.asarray(self.by_height(charge, self.energy_kev, noise), np.float32)
        return read(records, self.frame)


@dataclass(frozen=True, eq=False)
class Difference:
    """Means of some functions of the translated pulses less those of the data.

    Parameters
    ----------
    name
        What is compared.
    values, covariance
        Differences, and their covariance.
    slopes
        Derivatives in the coordinates of a basis, shape (functions, coordinates).
    parts
        Derivatives (parts, functions, coordinates) and differences (parts, functions) of equal
        parts of the simulated pulses.
    """

    name: str
    values: Values
    covariance: Values
    slopes: Values = field(default_factory=lambda: NONE)
    parts: tuple[Values, Values] | None = None

    @property
    def chi_square(self) -> float:
        """Per function."""
        return float(self.values @ np.linalg.solve(self.covariance, self.values)) / len(
            self.values
        )

    @property
    def white(self) -> tuple[Values, Values]:
        """Uncorrelated differences of unit variance, and their derivatives."""
        root = np.linalg.cholesky(self.covariance)
        both = np.column_stack([self.values, self.slopes])
        white = scipy.linalg.solve_triangular(root, both, lower=True)
        return white[:, 0], white[:, 1:]

    @property
    def shared(self) -> Values:
        """What :math:`J^T C^{-1} d` is on average where both sides agree, (coordinates,).

        It is not zero, since derivatives and differences are of the same pulses.
        """
        assert self.parts is not None
        slopes, values = self.parts
        n, off = len(values), np.linalg.solve(self.covariance, (values - values.mean(axis=0)).T)
        return np.asarray(np.einsum("pfk,fp->k", slopes, off) / (n * (n - 1)))

    @property
    def sliced(self) -> bool:
        """Whether it is a slice."""
        return self.name[-1].isdigit()


class Slice(NamedTuple):
    """Bounded functions of pulses in a slice, and what follows for their means.

    Parameters
    ----------
    data, noisy, slopes
        Functions of measured pulses, and of simulated ones with each draw of the noise, shape
        (draws, pulses, functions); derivatives of those with the first.
    rows, weights
        The simulated pulses, and their weights, shape (draws, pulses).
    shapes, noise
        Covariances.
    number, left
        Effective number of simulated pulses, and what draws leave of the noise.
    """

    data: Values
    noisy: Values
    slopes: Values
    rows: npt.NDArray[np.intp]
    weights: Values
    shapes: Values
    noise: Values
    number: float
    left: float


class Comparison:
    """Both sides behind a response.

    Parameters
    ----------
    sides
        Pulses as they enter the readout.
    transfer
        Spectrum of its response.
    width
        Width of the bounded functions in robust standard deviations.
    least
        Least error of a quantile.

    Attributes
    ----------
    noisy
        Translated pulses with each draw of the noise.
    """

    def __init__(
        self, sides: Sides, transfer: Spectrum, width: float, least: float = 1e-6
    ) -> None:
        self.sides, self.width, self.least = sides, width, least
        clean, self.heights = sides.translated(transfer)
        self.noisy = sides.noisy(clean, self.heights)
        self._views = [sides.view(draw.pulses) for draw in self.noisy]
        self._clean = sides.view(sides.read(clean, self.heights).pulses)

    def differences(self, basis: Moved | None = None) -> list[Difference]:
        """Differences of quantiles, then of slices, with derivatives in a basis if given."""
        moves = None if basis is None else basis(self.sides, self.noisy[0], self.heights)
        quantiles = [self._quantiles(by, moves) for by in RANKS]
        return quantiles + [own for by in RANKS for own in self._slices(by, moves)]

    def mean_pulse(self) -> Values:
        """Deviation of the mean of all pulses in its standard errors, by stretch.

        It is 0 within a sample of the half height, where all pulses are aligned.
        """
        single = self.sides.single(self.noisy[0])
        if single.sum() < 2:  # far from the data
            single[:] = True
        n = len(self.sides.data)
        whole = self._slice(
            np.ones(n), np.ones((len(self.noisy), 1)) * single, self._rms(single)
        )
        variance = whole.shapes.diagonal() * (1 / whole.number + 1 / n)
        variance = variance + whole.noise.diagonal() * (1 / n + whole.left)
        means = whole.noisy.mean(axis=(0, 1)), whole.data.mean(axis=0)
        z = (means[0] - means[1]) / np.sqrt(variance)
        aligned = np.abs(self.sides.time_ns) <= self.sides.frame.dt_ns
        return np.where(aligned, 0.0, z)

    def _rms(self, rows: Any) -> Values:
        """RMS of the noise in each stretch."""
        noise = self._views[0][rows] - self._clean[rows]
        return np.asarray(np.sqrt(np.mean(noise**2, axis=0, dtype=float)))

    def _quantiles(self, by: str, moves: Any) -> Difference:
        """Quantiles of a quantity."""
        own = getattr(self.sides.data, by)
        simulated = np.concatenate([getattr(draw, by) for draw in self.noisy])
        quantiles, slopes = np.quantile(simulated, QUANTILES), NONE
        errors = np.hypot(
            quantile_errors(own, len(own)), quantile_errors(simulated, len(self.sides))
        )
        covariance = np.outer(errors, errors) * CORRELATION
        covariance = covariance + self.least**2 * np.eye(len(errors))
        if moves is not None:
            near, _ = hats(getattr(self.noisy[0], by), quantiles)
            slopes = _means(near, getattr(moves, by))
        differences = quantiles - np.quantile(own, QUANTILES)
        return Difference(f"{by} quantiles", differences, covariance, slopes)

    def _slices(self, by: str, moves: Any) -> list[Difference]:
        """Means of bounded functions of every sample, in slices of a quantity."""
        values = [getattr(draw, by) for draw in self.noisy]
        every, own = np.concatenate(values), getattr(self.sides.data, by)
        of_data, _ = hats(own, np.quantile(own, RANKS[by]))
        centres = np.quantile(every, RANKS[by])
        of_sim, turned = zip(*(hats(value, centres) for value in values), strict=True)
        moved = NONE
        if moves is not None:  # relative to pulses of the same rank, with which slices move
            near, _ = hats(values[0], np.quantile(every, QUANTILES))
            moved = getattr(moves, by) - near @ _means(near, getattr(moves, by))
        slices, rms = list[Any](), self._rms(slice(None))
        for k in range(len(centres)):
            used = of_data[of_data[:, k] > 0, k]
            own = self._slice(of_data[:, k], np.array([of[:, k] for of in of_sim]), rms)
            mean = np.einsum("dp,dpf->f", own.weights, own.noisy) / own.weights.sum()
            difference, slopes = mean - used @ own.data / used.sum(), NONE
            if moves is not None:
                total = own.weights[0].sum()
                each = own.weights[0] / total
                slopes = moves.mean(own.rows, each[:, np.newaxis] * own.slopes)
                relative = own.noisy[0] - each @ own.noisy[0]
                sliding = relative * (turned[0][own.rows, k] / total)[:, np.newaxis]
                slopes += sliding.T.astype(np.float32) @ moved[own.rows]
            parts = own.shapes, own.noise, own.number, own.left
            slices.append((*parts, _effective(used), difference, slopes))
        shapes, noise = (sum(part[i] for part in slices) / len(slices) for i in (0, 1))
        # the inverse of a covariance from n samples is too large (Hartlap, A&A 464 (2007) 399)
        samples = max(1.0, 0.5 * len(values)) * len(self.sides)
        noise *= samples / max(samples - len(noise), 0.2 * samples)
        differences = []
        for k, (shape, _, n_sim, left, n_data, difference, slopes) in enumerate(slices):
            covariance = (1 - POOLED) * shape + POOLED * shapes
            covariance = covariance * (1 / n_sim + 1 / n_data) + noise * (1 / n_data + left)
            differences.append(Difference(f"{by} {k}", difference, covariance, slopes))
        return differences

    def _slice(self, of_data: Values, of_sim: Values, rms: Values) -> Slice:
        """Bounded functions in a slice, given the weights of data and of each draw."""
        rows, used = np.flatnonzero(of_sim.any(axis=0)), of_data > 0
        data = self.sides.data_view[used].astype(float)
        core = data[of_data[used] > 0.3 * of_data.max()]
        middle = np.median(core, axis=0)
        scale = self.width * np.maximum(1.4826 * np.median(np.abs(core - middle), axis=0), rms)

        def bounded(values: Floats) -> Values:
            return np.asarray(scale * np.tanh((values.astype(float) - middle) / scale))

        clean, noisy = (
            bounded(self._clean[rows]),
            np.array([bounded(v[rows]) for v in self._views]),
        )
        weights = of_sim[:, rows]
        mean_weights = weights.mean(axis=0)
        each = mean_weights / mean_weights.sum()
        centred = (clean - each @ clean) * np.sqrt(each)[:, np.newaxis]
        moved, total = noisy - clean, weights.sum()
        root = np.sqrt(weights / total)[:, :, np.newaxis] * moved
        root = root.reshape(-1, root.shape[-1])
        noise = root.T @ root + 1e-14 * np.eye(root.shape[1])
        # draws of opposite sign cancel as far as they are in the same slice
        sums = np.einsum("dp,dpf->pf", weights, moved) / total
        left = float((sums**2).sum() / noise.trace())
        slopes, shapes = 1 - (noisy[0] / scale) ** 2, centred.T @ centred
        number = _effective(mean_weights)
        return Slice(bounded(data), noisy, slopes, rows, weights, shapes, noise, number, left)


def quantile_errors(values: Values, n: int) -> Values:
    """Standard errors of the `QUANTILES` of `n` values: half of those an error of rank around.

    Where a rare population begins, as that of events at the contact, the error is as large as
    the jump to it, on whichever side of it the quantile is.
    """
    rank = np.sqrt(QUANTILES * (1 - QUANTILES) / n)
    low, high = (np.quantile(values, (QUANTILES + s * rank).clip(0, 1)) for s in (-1, 1))
    return np.asarray(0.5 * (high - low))


def _means(weights: Values, values: Values) -> Values:
    """Means by the weights of each column, shape (columns, ...)."""
    counts = np.maximum(weights.sum(axis=0), 1e-9)[:, np.newaxis]
    return np.asarray(weights.T @ values / counts)


def _effective(weights: Values) -> float:
    """Number of pulses of equal weight with the same error of the mean."""
    return float(weights.sum() ** 2 / (weights @ weights))


def hats(values: Values, centres: Values) -> tuple[Values, Values]:
    """Triangular bins that add up to 1, and their derivatives, shape (values, centres).

    Examples
    --------
    >>> bins, derivatives = hats(np.array([0.25, 9.0]), np.array([0.0, 1.0, 2.0]))
    >>> bins.tolist(), derivatives[0].tolist()
    ([[0.75, 0.25, 0.0], [0.0, 0.0, 1.0]], [-1.0, 1.0, 0.0])
    """
    low = (np.searchsorted(centres, values) - 1).clip(0, len(centres) - 2)
    distances, rows = centres[low + 1] - centres[low], np.arange(len(values))
    place = (values - centres[low]) / distances
    slope = ((place > 0) & (place < 1)) / distances
    place = place.clip(0, 1)
    bins, derivatives = np.zeros((2, len(values), len(centres)))
    bins[rows, low], bins[rows, low + 1] = 1 - place, place
    derivatives[rows, low], derivatives[rows, low + 1] = -slope, slope
    return bins, derivatives
