"""Noise with the spectrum of the data's own baselines, of any length.

Noise in ADC counts is the same for all pulses of a channel, so after normalisation it
goes as 1/energy: it is kept as prepared units times keV.  The spectrum comes from the
raw samples before the pulse and not from the short baseline of the prepared window,
which would lose the low frequencies that decide drift time and tail slope.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.optimize

from cpunet.electronics.exponentials import FloatArray as Values
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import PreparationConfig

LEAST_SAMPLES = 400  # of a baseline: 6.4 µs at 16 ns, a lowest frequency of 156 kHz
FEWEST = 30  # flat baselines
SHORTEST_SHARE = 0.1  # of the baselines may be shorter than those used
# Where a pulse is seen to begin, and the samples before that in which it may have crept up.
START_FRACTION, START_SIGMAS, MARGIN = 0.01, 8.0, 60
# Below the third frequency of a baseline its mean and the window's leakage hide the
# spectrum; there it follows from how the noise drifts apart over the baseline's length.
FIRST_CLEAN_BIN, RECORD_SAMPLES = 3, 8192
CORNERS, LAGS = 8, 40  # of the slow part's Lorentzians; at which the drift is compared
TRACES = 64  # drawn at a time, to bound memory
FLAT_SIGMAS, CLIPS = 4.0, 3  # robust standard deviations kept, and how often
SIGMA_PER_MAD = 1.4826


@dataclass(frozen=True, eq=False)
class BaselineNoise:
    """Spectrum of baseline noise.

    Parameters
    ----------
    density
        Mean square per sample and frequency bin, at the frequencies of a real FFT of
        `samples`: the expected square of a bin over `samples`, (prepared units x keV)^2.
    samples, dt_ns
        Length of that FFT and the sampling period.
    n_baselines
        How many flat baselines it was estimated from.
    """

    density: Values
    samples: int
    dt_ns: float
    n_baselines: int

    @classmethod
    def from_traces(cls, raw: Pulses, config: PreparationConfig) -> Self:
        """Estimate the spectrum from what precedes the pulses of raw traces.

        Parameters
        ----------
        raw
            Measured traces of one channel with their energies, any mixture of peaks.
        config
            How they are prepared: gives baseline and scale of each.

        Raises
        ------
        CpunetError
            If too few traces have a known energy and a flat baseline, or the
            baselines are shorter than 400 samples.
        """
        return cls._of_baselines(_baselines(raw, config), len(raw), raw.dt_ns)

    @classmethod
    def _of_baselines(cls, baselines: Values, n: int, dt_ns: float) -> Self:
        flat = baselines[_flat(baselines)] if len(baselines) else baselines
        if len(flat) < FEWEST:
            raise CpunetError(
                f"only {len(flat)} flat baselines among {n} traces; give more traces "
                f"(at least {FEWEST} with known energy)"
            )
        density = _with_slow_part(_periodogram(flat), _structure_function(flat))
        return cls(density, 2 * (len(density) - 1), dt_ns, len(flat))

    @classmethod
    def from_windows(cls, windows: Pulses, samples: int) -> Self:
        """Estimate the spectrum from the beginnings of prepared windows.

        For data that come prepared, without their raw traces.  Such baselines are short:
        noise slower than their length is guessed from its drift over them.

        Parameters
        ----------
        windows
            Prepared measured pulses with their energies.
        samples
            How many of each begin the window before any pulse does.

        Raises
        ------
        CpunetError
            If too few have a known energy and a flat baseline.
        """
        known = np.isfinite(windows.energy_kev) & (windows.energy_kev > 0)
        chosen = windows[known]
        baselines = chosen.waveforms[:, :samples] * chosen.energy_kev[:, np.newaxis]
        return cls._of_baselines(np.asarray(baselines, float), len(windows), windows.dt_ns)

    @property
    def rms(self) -> float:
        """Root mean square in prepared units times keV."""
        # all frequencies but the first and the last stand for two signs
        both = 2 * self.density.sum() - self.density[0] - self.density[-1]
        return float(np.sqrt(both / self.samples))

    def draw(
        self, energy_kev: npt.NDArray[np.float64], length: int, rng: np.random.Generator
    ) -> FloatArray:
        """Draw Gaussian noise for pulses of these energies.

        Several pulses take parts of one long trace: noise slower than a record is then much
        the same in neighbouring pulses, and moves their baselines alike.

        Parameters
        ----------
        energy_kev
            Energy of each pulse, shape ``(n,)``.
        length
            Samples of each.
        rng
            Where the randomness comes from.

        Returns
        -------
        numpy.ndarray
            Float32, shape ``(n, length)``, in prepared units.

        Raises
        ------
        CpunetError
            If an energy is not a positive number.
        """
        usable = np.isfinite(energy_kev) & (energy_kev > 0)
        if not usable.all():
            row = int(np.argmin(usable))
            raise CpunetError(
                f"pulse {row} has an energy of {energy_kev[row]} keV; noise is scaled by "
                "1/energy, so give the energies"
            )
        n = len(energy_kev)
        # Twice as long as needed, so that end and beginning know nothing of each other.
        long = max(scipy.fft.next_fast_len(2 * length, real=True), self.samples)
        each = max(1, (long - length) // length)  # parts of a trace; a gap stays at its end
        size = np.sqrt(0.5 * long * self.density_of(long)).astype(np.float32)
        noise = np.empty((n, length), np.float32)
        for first in range(0, n, each * TRACES):
            rows = noise[first : first + each * TRACES]
            shape = (-(-len(rows) // each), 2 * len(size))
            bins = rng.standard_normal(shape, np.float32).view(np.complex64) * size
            traces = scipy.fft.irfft(bins, long, axis=1, overwrite_x=True)
            rows[:] = traces[:, : each * length].reshape(-1, length)[: len(rows)]
        noise /= energy_kev[:, np.newaxis]
        return noise

    def density_of(self, length: int) -> Values:
        """Density at the frequencies of a real FFT of `length` samples."""
        known = np.arange(len(self.density)) / self.samples
        return np.asarray(
            np.interp(np.arange(length // 2 + 1) / length, known, self.density), float
        )


def _baselines(raw: Pulses, config: PreparationConfig) -> Values:
    """Samples before the pulse in prepared units times keV, equally many of each trace."""
    known = np.flatnonzero(np.isfinite(raw.energy_kev) & (raw.energy_kev > 0))
    prepared = prepare(raw[known], config, "measured")
    if len(prepared) < FEWEST:
        raise CpunetError(
            f"only {len(prepared)} of {len(raw)} traces have a known energy and can be "
            f"prepared; give {FEWEST} or more to take the noise from"
        )
    windows = prepared.pulses.waveforms[:, : config.samples_before]
    level = np.maximum(START_FRACTION, START_SIGMAS * prepared.baseline_rms)
    above = windows >= level[:, np.newaxis]
    # The start of the pulse proper: everything from there to the alignment is above.
    start = windows.shape[1] - (~above[:, ::-1]).argmax(axis=1)
    free = prepared.align_sample - config.samples_before + start - MARGIN
    length = int(np.quantile(free, SHORTEST_SHARE))
    if length < LEAST_SAMPLES:
        raise CpunetError(
            f"the traces have {max(length, 0)} samples before the pulse; the noise needs "
            f"{LEAST_SAMPLES} or more, so give traces with a longer baseline"
        )
    used = np.flatnonzero(free >= length)
    samples = raw.waveforms[known[prepared.index[used]], :length].astype(float)
    kev = prepared.pulses.energy_kev[used] / prepared.scale[used]
    return np.asarray(
        (samples - prepared.baseline[used, np.newaxis]) * kev[:, np.newaxis], float
    )


def _periodogram(baselines: Values) -> Values:
    samples = baselines.shape[1]
    window = np.hanning(samples + 1)[:-1]
    centred = (baselines - baselines.mean(axis=1, keepdims=True)) * window
    power = np.abs(scipy.fft.rfft(centred, axis=1)) ** 2
    return np.asarray(power.mean(axis=0) / (window @ window), float)


def _structure_function(baselines: Values) -> Values:
    """Half the mean square difference of samples 0, 1, 2 ... apart.

    Unlike a spectrum it needs no mean to be taken off, so that nothing is lost of noise
    slower than the baseline.
    """
    n, samples = baselines.shape
    padded = scipy.fft.next_fast_len(2 * samples, real=True)
    centred = baselines - baselines.mean(axis=1, keepdims=True)
    power = np.zeros(padded // 2 + 1)
    for rows in range(0, n, 512):
        power += (np.abs(scipy.fft.rfft(centred[rows : rows + 512], padded)) ** 2).sum(axis=0)
    products = scipy.fft.irfft(power, padded)[:samples]
    squares = np.cumsum((centred**2).sum(axis=0))
    lag = np.arange(samples)
    # the squares of the samples that have a partner later, and of those that have one earlier
    left, right = squares[samples - 1 - lag], squares[-1] - np.r_[0, squares[:-1]]
    return np.asarray((0.5 * (left + right) - products) / (n * (samples - lag)), float)


def _with_slow_part(density: Values, drift: Values) -> Values:
    """The spectrum down to the frequencies of `RECORD_SAMPLES`.

    Parameters
    ----------
    density, drift
        Periodogram and structure function of the baselines.

    Returns
    -------
    array
        Density at the frequencies of a real FFT of `RECORD_SAMPLES`: as measured from
        `FIRST_CLEAN_BIN` on, and rising from there towards 0 by a sum of Lorentzians, none
        of them negative, whose structure function comes closest to `drift`.
    """
    samples = len(drift)
    frequency = np.arange(RECORD_SAMPLES // 2 + 1) / RECORD_SAMPLES
    known = np.arange(len(density)) / samples
    join = known[FIRST_CLEAN_BIN]
    fast = np.interp(frequency, known[FIRST_CLEAN_BIN:], density[FIRST_CLEAN_BIN:])
    corners = np.geomspace(2 / RECORD_SAMPLES, join, CORNERS)[:, np.newaxis]
    slow = 1 / (1 + (frequency / corners) ** 2) - 1 / (1 + (join / corners) ** 2)
    slow = np.maximum(slow, 0)
    lags = np.unique(np.geomspace(4, 0.9 * samples, LAGS).astype(int))
    # both signs of the frequency; a density of 1 is a mean square of 1
    apart = 2 * (1 - np.cos(2 * np.pi * lags[:, np.newaxis] * frequency)) / RECORD_SAMPLES
    weights = 1 / drift[lags]
    rest = (drift[lags] - apart @ fast) * weights
    heights, _ = scipy.optimize.nnls((apart @ slow.T) * weights[:, np.newaxis], rest)
    return np.asarray(fast + heights @ slow, float)


def _flat(baselines: Values) -> npt.NDArray[np.bool_]:
    """Tell which baselines neither slope nor hold another pulse."""
    lever = np.arange(baselines.shape[1]) - 0.5 * (baselines.shape[1] - 1)
    slope = baselines @ lever / (lever @ lever)
    mean = baselines.mean(axis=1)
    lines = mean[:, np.newaxis] + slope[:, np.newaxis] * lever
    width = (baselines - lines).std(axis=1)
    flat = np.ones(len(baselines), bool)
    for _ in range(CLIPS):
        for values in (slope, width):
            centre = np.median(values[flat])
            sigma = SIGMA_PER_MAD * np.median(np.abs(values[flat] - centre))
            flat &= np.abs(values - centre) <= FLAT_SIGMAS * sigma
    return flat
