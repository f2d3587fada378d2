"""Baseline methods a user would choose instead of a network, fitted to the same datasets.

Each is a linear response applied to windows: a kernel on the current, then the decay. A window
is padded before the response is applied. No charge moves before the window, and all is
collected by its end, so the current is zero on both sides. The padding holds the parts of the
response outside the window and allows the window to be cut again after a later alignment.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.optimize
import scipy.signal

from cpunet.electronics.finishing import padding, record_length
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, blocks
from cpunet.pulses.parameters import current_amplitude, tail_slope

Values = npt.NDArray[np.float64]
Spectrum = npt.NDArray[np.complex128]

MIN_PULSES = 50  # of either dataset, for a fit
TAIL_SHARE = 0.75  # of the time after the alignment: 4.8 of 6.4 us, as in the paper


def currents(windows: FloatArray, dt_ns: float) -> Values:
    """Charge collected per sample over the whole record, shape ``(n, record)``."""
    n, length = windows.shape
    record, (before, _) = np.zeros((n, record_length(length, dt_ns))), padding(dt_ns)
    record[:, before : before + length] = np.diff(windows.astype(float), axis=1, prepend=0.0)
    return record


def integrated(current: Values, tail_slope_per_ms: float, dt_ns: float) -> Values:
    r"""Integrate currents to charge pulses, where each step decays exponentially.

    .. math:: s_j = e^{\lambda \Delta t} s_{j-1} + x_j

    Parameters
    ----------
    current
        Charge collected per sample, shape ``(n, samples)``.
    tail_slope_per_ms
        Logarithmic slope :math:`\lambda` of the tail in 1/ms, negative for a decay.
    dt_ns
        Sampling period :math:`\Delta t` in ns.

    Examples
    --------
    >>> charge = integrated(np.array([[0.0, 1.0, 0.0, 0.0]]), -20.0, 50_000.0)
    >>> charge.round(3).tolist()  # a decay time of 50 us
    [[0.0, 1.0, 0.368, 0.135]]
    """
    remaining = np.exp(tail_slope_per_ms * dt_ns * 1e-6)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -remaining], current, axis=1), float)


def respond(
    windows: FloatArray, transfer: Spectrum, tail_slope_per_ms: float, dt_ns: float
) -> FloatArray:
    """Apply a kernel and a decay to windows.

    Parameters
    ----------
    windows
        Simulated pulses, shape ``(n, length)``.
    transfer
        Transfer function of the kernel at the frequencies of the record.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms, negative for a decay.
    dt_ns
        Sampling period in ns.

    Returns
    -------
    numpy.ndarray
        Records, float32, shape ``(n, record_length(length, dt_ns))``.
    """
    length = record_length(windows.shape[1], dt_ns)
    records = np.empty((len(windows), length), np.float32)
    for rows in blocks(len(windows)):
        spectrum = scipy.fft.rfft(currents(windows[rows], dt_ns), axis=1) * transfer
        current = scipy.fft.irfft(spectrum, length, axis=1)
        records[rows] = integrated(current, tail_slope_per_ms, dt_ns)
    return records


def tail_samples(length: int, align: int) -> int:
    """Number of samples at the end of a window that contain only the decay."""
    return max(3, int(TAIL_SHARE * (length - align)))


def fitted_tail_slope(data: FloatArray, dt_ns: float, align: int) -> float:
    """Median logarithmic slope of the tails, in 1/ms.

    Raises
    ------
    CpunetError
        If no tail is positive.
    """
    slopes = tail_slope(data, dt_ns, tail_samples(data.shape[1], align))
    slopes = slopes[np.isfinite(slopes)]
    if not slopes.size:
        raise CpunetError("no measured pulse has a positive tail; check their polarity")
    return float(np.median(slopes))


def without_decay(
    data: FloatArray, tail_slope_per_ms: float, dt_ns: float, align: int
) -> Values:
    r"""Undo the decay (pole-zero correction) and scale the pulses to unit height.

    .. math:: x_j = \sum_{k \le j} \left(s_k - e^{\lambda \Delta t} s_{k-1}\right)

    with the logarithmic slope :math:`\lambda` of the tail.

    Parameters
    ----------
    data
        Windows of shape ``(n, length)`` with the baseline at 0.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    dt_ns
        Sampling period in ns.
    align
        Sample at which the windows are aligned.

    Examples
    --------
    An exponential decay becomes a step.

    >>> decay = np.r_[np.zeros(10), np.exp(-np.arange(30) * 0.016 / 50)]  # 50 us
    >>> without_decay(decay[np.newaxis], -20.0, 16.0, 10)[0, [9, 10, 39]].round(6).tolist()
    [0.0, 1.0, 1.0]
    """
    remaining = np.exp(tail_slope_per_ms * dt_ns * 1e-6)
    current = data.astype(float)
    current[:, 1:] -= remaining * data[:, :-1]
    steps = np.cumsum(current, axis=1)
    heights = steps[:, -tail_samples(data.shape[1], align) :].mean(axis=1, keepdims=True)
    return np.asarray(steps / heights, float)


def fitted_decay(
    sim: FloatArray, data: FloatArray, dt_ns: float, align: int, most: int
) -> tuple[float, FloatArray]:
    """Tail slope (1/ms) of the data, and the first `most` of these without it.

    Raises
    ------
    CpunetError
        If a side has too few pulses, or no tail is positive.
    """
    for side, windows in (("simulated", sim), ("measured", data)):
        if len(windows) < MIN_PULSES:
            raise CpunetError(
                f"{len(windows)} {side} pulses; give {MIN_PULSES} or more to fit a response to"
            )
    slope = fitted_tail_slope(data, dt_ns, align)
    return slope, without_decay(data[:most], slope, dt_ns, align).astype(np.float32)


@dataclass(frozen=True)
class BaselineMethod(ABC):
    """A baseline method: a causal linear response fitted to unpaired pulses.

    Parameters
    ----------
    dt_ns
        Sampling period in ns of the pulses in the fit.
    """

    dt_ns: float
    name: ClassVar[str]

    @classmethod
    @abstractmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Fit to simulated and measured pulses of different events.

        Parameters
        ----------
        sim, data
            Prepared windows, shape ``(n, length)``. Simulated ones range from 0 to 1.
        dt_ns
            Sampling period in ns.
        align
            Sample at which both are aligned.

        Raises
        ------
        CpunetError
            If there are too few pulses.
        """

    @abstractmethod
    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Noise-free response to simulated windows.

        Returns
        -------
        numpy.ndarray
            Records with padding on both sides of the window (see `respond`), neither
            aligned nor normalised. `finishing.finish` converts them into windows.
        """

    def describe(self) -> Mapping[str, float]:
        """Fitted values by name. Each name ends with the unit."""
        return {name: value for name, value in asdict(self).items() if name != "dt_ns"}


LONGEST_NS = 1024.0  # maximum sigma and tau
MAX_PULSES = 4000  # maximum number of pulses in the fit
TOLERANCE = 1e-3  # precision of tau, in samples


@dataclass(frozen=True)
class RC(BaselineMethod):
    r"""A single RC integration followed by an exponential decay.

    .. math:: s_j = s_{j-1} + (x_{j-1} - s_{j-1})\, \Delta t / \tau

    Parameters
    ----------
    tau_ns
        Time constant of the integration in ns, at least one sampling period.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    """

    tau_ns: float
    tail_slope_per_ms: float
    name: ClassVar[str] = "rc"

    @classmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Match the mode of the current amplitudes and the tails, see `BaselineMethod.fit`.

        Raises
        ------
        CpunetError
            For the reasons of `BaselineMethod.fit`, or if the data are slower than the maximum
            tau.
        """
        slope, steps = fitted_decay(sim, data, dt_ns, align, MAX_PULSES)
        wanted = most_frequent(current_amplitude(steps, dt_ns))
        before, longest = padding(dt_ns)[0], LONGEST_NS / dt_ns
        window = slice(before, before + sim.shape[1])
        current = currents(sim[:MAX_PULSES], dt_ns)

        def excess(tau: float) -> float:
            response = np.cumsum(_integration(current, 1 / tau), axis=1)[:, window]
            return most_frequent(current_amplitude(response.astype(np.float32), dt_ns)) - wanted

        if excess(1.0) <= 0:
            # The data rise faster than the simulation: any integration makes it worse.
            return cls(dt_ns, dt_ns, slope)
        if excess(longest) > 0:
            raise CpunetError(
                f"the measured pulses rise slower than an RC of {LONGEST_NS:g} ns makes "
                "them; check the sampling period and the pulses of both sides"
            )
        tau = float(scipy.optimize.brentq(excess, 1.0, longest, xtol=TOLERANCE))
        return cls(dt_ns, tau * dt_ns, slope)

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Apply the integration and the decay, see `BaselineMethod.translate`."""
        length = record_length(waveforms.shape[1], self.dt_ns)
        records = np.empty((len(waveforms), length), np.float32)
        for rows in blocks(len(waveforms)):
            current = _integration(
                currents(waveforms[rows], self.dt_ns), self.dt_ns / self.tau_ns
            )
            records[rows] = integrated(current, self.tail_slope_per_ms, self.dt_ns)
        return records


def most_frequent(values: Values) -> float:
    """Median of the shortest interval that contains half of the values.

    For current amplitudes this is the single-site peak, which is the narrowest.

    Examples
    --------
    >>> most_frequent(np.array([0.0, 1.0, 5.0, 5.1, 5.2, 9.0]))
    5.1
    """
    ordered = np.sort(values[np.isfinite(values)])
    half = len(ordered) // 2
    if half == 0:
        raise CpunetError("no pulse has a current amplitude; check the prepared pulses")
    first = int(np.argmin(ordered[half:] - ordered[: len(ordered) - half]))
    return float(np.median(ordered[first : first + half]))


def _integration(current: Values, rate: float) -> Values:
    """Apply siggen's recursion. `rate` is the sampling period divided by tau."""
    return np.asarray(scipy.signal.lfilter([0.0, rate], [1.0, rate - 1.0], current), float)
