"""Moments that compare two unpaired sets: means over events of many functions of a pulse.

The functions are means over stretches of the pulse, principal components, the tail slope,
squares of these, and bins of the current amplitude.  With their covariance from the data's own
events, the distance of two sets is a chi-square: directions in which events differ by their
physics have little weight, those in which only noise moves them have much (generalised method
of moments; Hansen, Econometrica 50 (1982) 1029).  The bins of the current amplitude are narrow
because its sharp features, such as the edge of the single-site events, determine the bandwidth
four times better than its mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import current_amplitude_kernel
from cpunet.recipes.schema import MatchingConfig, PreparationConfig
from cpunet.training._record_kernels import RecordWindow, project, read_records
from cpunet.training.dual_numbers import Dual

Values = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]

SIGMA_PER_MAD = 1.4826
MIN_PULSES = 200  # minimum number of pulses for a covariance of about a hundred moments
EDGE_NS = 960.0  # on either side of the half maximum, contains the steepest point
MIN_SHARE = 0.2  # of the median amplitude; below it, there is no single pulse
QUIET = 0.05  # of the height; above it before the pulse, there is another pulse
# Maximum number of measured pulses that define the functions, and pulses read at a time.
DRAWN, BLOCK = 8192, 512


@dataclass(frozen=True, eq=False)
class Readings:
    """Quantities read from each pulse, from which the functions are computed.

    Parameters
    ----------
    linear
        Stretches, components and tail slope relative to the medians of the data, in robust
        standard deviations, shape (pulses, quantities).
    log_amplitude
        Logarithm of the current amplitude, shape (pulses,).
    weights
        Weights of the pulses, shape (pulses,).
    """

    linear: Values
    log_amplitude: Values
    weights: Values

    def __len__(self) -> int:
        return len(self.linear)

    def __getitem__(self, rows: npt.NDArray[np.bool_] | Rows | slice) -> Readings:
        return Readings(self.linear[rows], self.log_amplitude[rows], self.weights[rows])


@dataclass(frozen=True, eq=False)
class Moments:
    r"""The functions whose means are compared, defined by the measured set.

    Moments are the means of functions :math:`f_i` of single pulses.  With their covariance
    :math:`V` from the data's events, two sets differ by

    .. math:: \chi^2 = \Delta^T V^{-1} \Delta, \qquad
        \Delta_i = \langle f_i \rangle_{\mathrm{sim}} - \langle f_i \rangle_{\mathrm{data}}

    Use `of_data`; `read` and `functions` then evaluate them for any set.

    Parameters
    ----------
    data
        Readings of the measured pulses that are used.
    values
        Functions of these, shape (pulses, moments).
    names
        Names of the moments.
    left_out
        Number of measured pulses excluded, since they are not single with a flat baseline.
    slope_range
        Lowest and highest tail slope of the data.  Quality cuts limit it, so simulated pulses
        beyond it are excluded, too: with a fast decay the tails of late pulses are steeper, and
        such a cut removes more of them.
    """

    config: MatchingConfig
    preparation: PreparationConfig
    level: float
    mean: FloatArray
    components: FloatArray
    centres: Values
    spreads: Values
    amplitude_centres: Values
    amplitude_widths: Values
    data: Readings
    values: Values
    names: tuple[str, ...]
    left_out: int = 0
    slope_range: tuple[float, float] = (-np.inf, np.inf)

    @classmethod
    def of_data(
        cls, windows: FloatArray, config: MatchingConfig, preparation: PreparationConfig
    ) -> Moments:
        """Define the moments by prepared measured pulses, shape (pulses, samples).

        Raises
        ------
        CpunetError
            If there are too few pulses.
        """
        whole = np.flatnonzero([np.isfinite(block).all() for block in windows])
        some = whole[spread(len(whole), DRAWN)]
        level = 0.5 * float(windows[some].mean(axis=0).max()) if len(some) else 0.0
        window = _window(config, preparation, level, preparation.samples_before + 2)
        aligned, slopes, log_amplitude = _read_windows(windows[some], window, preparation)
        usable = _single(aligned, config)
        if usable.any():
            usable &= log_amplitude > _least(log_amplitude[usable])
        if usable.sum() < MIN_PULSES:
            raise CpunetError(
                f"{int(usable.sum())} measured pulses can be used; {MIN_PULSES} or more are "
                "needed: select more energies (`peak`) or give more files"
            )
        least = _least(log_amplitude[usable])
        aligned, slopes, log_amplitude = aligned[usable], slopes[usable], log_amplitude[usable]
        mean, components = _principal_components(aligned, config.components)
        edges = np.quantile(log_amplitude, np.linspace(0.02, 0.995, config.amplitude_bins + 1))
        plain = cls(
            config=config,
            preparation=preparation,
            level=level,
            mean=mean,
            components=components,
            centres=np.zeros(1),
            spreads=np.ones(1),
            amplitude_centres=0.5 * (edges[1:] + edges[:-1]),
            amplitude_widths=np.maximum(np.diff(edges), config.amplitude_width),
            data=Readings(np.empty((0, 1)), np.empty(0), np.empty(0)),
            values=np.empty((0, 0)),
            names=_names(config),
        )
        linear = plain._linear(aligned, slopes)
        centres = np.median(linear, axis=0)
        spreads = SIGMA_PER_MAD * np.median(np.abs(linear - centres), axis=0)
        scaled = replace(plain, centres=centres, spreads=np.maximum(spreads, 1e-9))
        data = scaled.read_windows(windows, whole, window, least)
        slopes = data.linear[:, -1] * scaled.spreads[-1] + centres[-1]
        rounding = 1e-4 * scaled.spreads[-1]
        return replace(
            scaled,
            data=data,
            values=scaled.functions(data),
            left_out=len(windows) - len(data),
            slope_range=(slopes.min() - rounding, slopes.max() + rounding),
        )

    def read(
        self, records: FloatArray, last: int, weights: Values | None = None
    ) -> tuple[Readings, npt.NDArray[np.bool_]]:
        """Read records with noise.

        Parameters
        ----------
        records
            Shape (pulses, samples), of about the height of prepared pulses; changed in place.
        last
            Sample after all half maxima.
        weights
            Weights of the pulses; 1 by default.

        Returns
        -------
        tuple
            Readings of the pulses that can be aligned, and whether the tail slope of each is
            outside the range of the data.
        """
        aligned, slopes, log_amplitude, _ = aligned_records(records, self.window(last))
        linear = self._linear(aligned, slopes)
        beyond = (slopes < self.slope_range[0]) | (slopes > self.slope_range[1])
        counts = np.isfinite(linear).all(axis=1) & np.isfinite(log_amplitude)
        readings = Readings(
            linear, log_amplitude, np.ones(len(linear)) if weights is None else weights
        )
        return (readings, beyond) if counts.all() else (readings[counts], beyond[counts])

    def window(self, last: int) -> RecordWindow:
        """Where records are read whose half maxima are before a sample."""
        return _window(self.config, self.preparation, self.level, last)

    def functions(self, readings: Readings, clip: float | None = None) -> Values:
        r"""Functions of each pulse, shape (pulses, moments).

        They are the clipped linear quantities, squares of components and tail slope, and bins
        :math:`b` of the current amplitude :math:`A`, with smooth edges:

        .. math:: f_b = \exp\left[-\frac{(\ln A - c_b)^2}{2 w_b^2}\right]

        Parameters
        ----------
        readings
            Readings of the pulses, as arrays or with derivatives (`Dual`).
        clip
            Replaces the clip of the recipe: wider far from the data, where all is clipped.
        """
        limit = clip or self.config.clip
        density = gaussian_bins(
            readings.log_amplitude, self.amplitude_centres, self.amplitude_widths
        )
        linear = readings.linear.clip(-limit, limit)
        first = len(self.config.segments) - 1
        squared = linear[:, first : first + self.config.squares] ** 2
        all_of_them: Values = joined([linear, squared, linear[:, -1:] ** 2, density])
        return all_of_them

    @cached_property
    def quantities(self) -> FloatArray:
        """Stretches and components as a matrix, shape (samples, quantities)."""
        config, stretches = self.config, list(pairwise(self.config.segments))
        matrix = np.zeros((len(self.mean), len(stretches)), np.float32)
        for column, (first, stop) in enumerate(stretches):
            matrix[config.before + first : config.before + stop, column] = 1 / (stop - first)
        return np.concatenate([matrix, self.components], axis=1)

    @cached_property
    def offset(self) -> Values:
        """Components of the mean pulse."""
        return np.asarray(self.mean.astype(float) @ self.components)

    @property
    def dt_ns(self) -> float:
        """Sampling period in ns."""
        return self.preparation.sampled_ns

    @property
    def slope(self) -> float:
        """Median slope per sample of the logarithm of the data's tails."""
        return float(self.centres[-1])

    def _linear(self, aligned: FloatArray, slopes: Values) -> Values:
        """Stretches, components and tail slope as in `Readings`."""
        matrix = self.quantities
        out = np.empty((len(aligned), matrix.shape[1]), np.float32)
        project(aligned, matrix, out)
        linear = np.concatenate([out, slopes[:, np.newaxis]], axis=1, dtype=float)
        linear[:, -1 - self.components.shape[1] : -1] -= self.offset
        return (linear - self.centres) / self.spreads

    def read_windows(
        self, windows: FloatArray, whole: Rows, window: RecordWindow, least: float
    ) -> Readings:
        """Readings of the prepared measured pulses that are used."""
        linear, log_amplitude = [], []
        for first in range(0, len(whole), BLOCK):
            block = windows[whole[first : first + BLOCK]]
            aligned, slopes, logs = _read_windows(block, window, self.preparation)
            usable = _single(aligned, self.config) & (logs > least)
            linear.append(self._linear(aligned, slopes)[usable])
            log_amplitude.append(logs[usable])
        logs = np.concatenate(log_amplitude)
        return Readings(np.concatenate(linear), logs, np.ones(len(logs)))


# The functions take arrays, and arrays with derivatives (`Dual`).


def joined(columns: Sequence[Any]) -> Any:
    """Columns side by side."""
    if isinstance(columns[0], Dual):
        return Dual.joined(columns)
    return np.concatenate(columns, axis=1)


def gaussian_bins(values: Any, centres: Values, widths: Values) -> Any:
    """Bins with smooth edges, shape (pulses, bins)."""
    distance = (values[:, np.newaxis] - centres) / widths
    exponent = distance**2 * -0.5
    return np.exp(exponent) if isinstance(exponent, np.ndarray) else exponent.exp()


def products(values: Any, bins: Any) -> Any:
    """Each of some values times each bin, shape (pulses, products)."""
    columns = values.shape[1] * bins.shape[1]  # given, since a block of pulses can be empty
    return (values[:, :, np.newaxis] * bins[:, np.newaxis, :]).reshape(len(values), columns)


def spread(n: int, most: int) -> Rows:
    """Rows of at most `most` of `n` pulses, spread over all: files can be in any order."""
    return np.linspace(0, n - 1, min(n, most)).astype(np.intp)


def _window(
    config: MatchingConfig, preparation: PreparationConfig, level: float, last: int
) -> RecordWindow:
    return RecordWindow(
        level=level,
        last=last,
        before=config.before,
        after=config.after,
        base_first=config.baseline[0],
        base_stop=config.baseline[1],
        level_samples=config.level_samples,
        tail_level=preparation.tail_level,
        tail=preparation.samples_after - preparation.decay_fit_samples,
        fit_samples=preparation.decay_fit_samples,
        edge=config.samples(EDGE_NS),
        dt_ns=config.sampled_ns,
    )


def aligned_records(
    records: FloatArray, window: RecordWindow
) -> tuple[FloatArray, Values, Values, Values]:
    """Aligned pulses, tail slopes, logarithms of the current amplitude, places where read."""
    n = len(records)
    aligned = np.empty((n, window.before + window.after), np.float32)
    slopes, amplitudes, places = np.empty(n), np.empty(n), np.empty((n, 6))
    weights = current_amplitude_kernel(window.dt_ns)
    read_records(records, window, weights, aligned, slopes, amplitudes, places)
    return aligned, slopes, np.log(np.maximum(amplitudes, 1e-4)), places


def _read_windows(
    windows: FloatArray, window: RecordWindow, preparation: PreparationConfig
) -> tuple[FloatArray, Values, Values]:
    """The same of prepared windows, whose tails are where the preparation put them."""
    records = np.array(windows, np.float32)  # a copy, to be changed in place
    aligned, _, log_amplitude, _ = aligned_records(records, window)
    tails = records[:, -preparation.decay_fit_samples :]
    lever = np.arange(tails.shape[1]) - 0.5 * (tails.shape[1] - 1)
    slopes = np.log(np.maximum(tails, np.float32(1e-3))) @ (lever / (lever @ lever))
    return aligned, slopes, log_amplitude


def _single(aligned: FloatArray, config: MatchingConfig) -> npt.NDArray[np.bool_]:
    """Whether pulses are whole, with nothing before them."""
    before = np.abs(aligned[:, : max(1, config.before // 4)].mean(axis=1))
    return np.asarray(np.isfinite(aligned).all(axis=1) & (before < QUIET))


def _least(log_amplitude: Values) -> float:
    """Logarithm of the current amplitude below which there is no single pulse."""
    return float(np.log(MIN_SHARE) + np.median(log_amplitude))


def _principal_components(aligned: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Mean, and the first components in units of their standard deviation, (samples, n)."""
    mean = aligned.mean(axis=0)
    covariance = np.cov(aligned.T.astype(float), bias=True)
    size = len(covariance)
    # only the leading ones: all of them can take seconds
    variances, axes = scipy.linalg.eigh(
        covariance, subset_by_index=(max(size - n, 0), size - 1)
    )
    variances, axes = variances[::-1], axes[:, ::-1]
    scaled = axes / np.sqrt(np.maximum(variances, np.finfo(float).tiny))
    return mean, np.ascontiguousarray(scaled, np.float32)


def stretch_name(begin_ns: float, end_ns: float) -> str:
    """Name of the mean over a stretch of the pulse."""
    return f"{begin_ns:g} to {end_ns:g} ns"


def _names(config: MatchingConfig) -> tuple[str, ...]:
    return (
        *(stretch_name(a, b) for a, b in pairwise(config.segments_ns)),
        *(f"component {i + 1}" for i in range(config.components)),
        "tail slope",
        *(f"component {i + 1} squared" for i in range(config.squares)),
        "tail slope squared",
        *(f"current amplitude, bin {i + 1}" for i in range(config.amplitude_bins)),
    )
