"""Between simulation and data: a readout chain with its noise, and the linear inverse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import KINDS, BaselineNoise, record_samples
from cpunet.electronics.drawn_pile_up import DrawnTails
from cpunet.networks import Stored
from cpunet.networks.response_layer import ElectronicsResponse, Floats, Values
from cpunet.recipes.schema import MatchingConfig, ResponseConfig

Residual = Callable[[Floats], npt.NDArray[np.float32]]


class KeptNoise(Stored):
    """Spectra of noise, to be stored.

    Parameters
    ----------
    dt_ns
        Sampling period in ns.
    """

    def __init__(self, dt_ns: float) -> None:
        self.noise_dt_ns = float(dt_ns)
        bins = record_samples(dt_ns) // 2 + 1
        # (prepared units x keV)^2, see `BaselineNoise`; kinds that are absent have a share of 0
        self.noise_continua = np.zeros((KINDS, bins), np.float32)
        self.noise_lines = np.zeros((KINDS, bins), np.float32)
        self.noise_shares = np.zeros(KINDS)
        self.n_baselines = np.array(0)

    def set_noise(self, noise: BaselineNoise) -> None:
        """Store a measured spectrum."""
        given = noise.at(record_samples(self.noise_dt_ns))
        own: Any = self.noise_continua, self.noise_lines, self.noise_shares
        for array, values in zip(own, given, strict=True):
            array[...] = 0
            array[: len(values)] = values
        self.n_baselines[...] = noise.n_baselines

    @property
    def noise(self) -> BaselineNoise:
        """The noise, to be drawn from."""
        present, dt_ns = self.noise_shares > 0, self.noise_dt_ns
        stored = self.noise_continua, self.noise_lines, self.noise_shares
        continua, lines, shares = (array[present].astype(float) for array in stored)
        mean, n = shares @ (continua + lines), int(self.n_baselines)
        kinds = continua, lines, shares
        return BaselineNoise(mean, record_samples(dt_ns), dt_ns, n, *kinds)


AFTER_NS = 2720.0  # from the half maximum until charge and slow response have arrived
MIN_LEVEL = 1e-3  # of a pulse


class LinearInverse(Stored):
    """Prepared measured windows → simulation-like, almost noise-free pulses.

    Of all linear functions of a measured pulse it comes closest to the charge pulse on average
    (the Wiener filter of these pulses in this noise).  Windows are aligned at half maximum by
    whole samples: shifts by fractions of a sample would smooth the steep part,
    and degrade the map.

    A new inverse holds zeros: load weights, or let `cpunet.training.inverse` fit them.

    Parameters
    ----------
    length
        Samples of a window.
    config
        Comparison by which the response was matched, which says where windows are scaled.

    Attributes
    ----------
    before, after : int
        Samples on either side of the half maximum that are translated.
    baseline, level : tuple of int
        First sample and stop, from the half maximum, of the parts that are scaled to 0 and 1.
    """

    residual: Residual | None = None
    """What a network adds to the pulses."""

    def __init__(self, length: int, config: MatchingConfig) -> None:
        self.length = length
        after = config.samples(config.after_ns)
        self.before, stop = map(config.samples, config.baseline_ns)
        self.after = min(config.samples(AFTER_NS), after)
        self.baseline = (-self.before, -stop)
        self.level = (after - config.samples(config.level_ns), after)
        n = self.before + self.after
        self.half_height = np.array(0.0)  # half of the maximum, the same for all windows
        self.mean_in, self.mean_out, self.weights = np.zeros(n), np.zeros(n), np.zeros((n, n))

    def __call__(self, windows: Floats) -> Floats:
        """Translate measured windows.

        Parameters
        ----------
        windows
            Prepared measured pulses, shape (n, length).

        Returns
        -------
        array
            Shape (n, length): pulses within 0 … 1 at the times of the measured ones,
            to be aligned and normalised like simulated ones.  NaN where a window has NaN.
        """
        sample, inside, _ = self.region(windows)
        # charge is within 0 … 1; ripples beyond that would affect the scale of the pulses
        pulses = (self.mean_out + (inside - self.mean_in) @ self.weights.T).clip(0, 1)
        # 0 before the region and 1 after it: a sample on either side stands for the rest
        pulses = np.pad(pulses, ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1)))
        start = 1 + self.before - sample
        whole = stretch(pulses, start, 0, self.length).astype(windows.dtype)
        return whole if self.residual is None else whole + self.residual(whole)

    def region(self, windows: Floats) -> tuple[npt.NDArray[np.intp], Values, Values]:
        """What is translated of windows, shape (n, length).

        Returns
        -------
        tuple of array
            Sample of the half maximum of each: the last below it before the maximum.  The
            stretch about it with baseline 0 and level 1, float64.  Mean of the tail above that
            before the pulse, which has become 1.
        """
        index = np.arange(windows.shape[1])
        below = (windows < self.half_height) & (index < windows.argmax(axis=1, keepdims=True))
        sample = np.maximum((below * (index + 1)).max(axis=1) - 1, 0)
        base, tail = (
            stretch(windows, sample, *ends).mean(axis=1, dtype=float)
            for ends in (self.baseline, self.level)
        )
        inside = stretch(windows, sample, -self.before, self.after) - base[:, np.newaxis]
        level = tail - base
        return sample, inside / np.maximum(level, MIN_LEVEL)[:, np.newaxis], level


def stretch(pulses: Any, sample: npt.NDArray[np.intp], first: int, stop: int) -> Floats:
    """Samples `first` to `stop`, counted from `sample` of each pulse; edges are repeated.

    Parameters
    ----------
    pulses
        Shape (..., n, samples).
    sample
        Sample from which is counted, shape (n,).
    """
    index = (sample[:, np.newaxis] + np.arange(first, stop)).clip(0, pulses.shape[-1] - 1)
    rows = np.arange(len(sample))[:, np.newaxis]
    return np.asarray(pulses[..., rows, index])


class ResponseGenerator(KeptNoise):
    """A response and a spectrum of noise, saved together.

    Parameters
    ----------
    config
        Configuration of the response.
    dt_ns
        Sampling period in ns.
    """

    tails: DrawnTails | None = None
    """Pile-up tails, which are added to records with the noise."""

    residual: Residual | None = None
    """What a network adds to records."""

    def __init__(self, config: ResponseConfig, dt_ns: float) -> None:
        super().__init__(dt_ns)
        self.response = ElectronicsResponse(config, dt_ns)

    def __call__(self, windows: Floats) -> npt.NDArray[np.float32]:
        """Noise-free records of prepared simulated windows, as from `ElectronicsResponse`."""
        records = self.response(windows)
        return records if self.residual is None else records + self.residual(records)
