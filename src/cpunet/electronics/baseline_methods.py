"""Baseline methods a user would choose instead of a network, fitted to the same datasets.

Each is a linear response applied to windows: a kernel on the current, then the decay. A window
is padded before the response is applied. No charge moves before the window, and all is
collected by its end, so the current is zero on both sides. The padding holds the parts of the
response outside the window and allows the window to be cut again after a later alignment.

RC is fitted here; kernels that are fitted to superpulses, and the table of all methods, are in
`cpunet.electronics.superpulses`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
import scipy.optimize
import scipy.signal

from cpunet.electronics.chain import ComplexArray as Spectrum
from cpunet.electronics.chain import FloatArray as Values
from cpunet.electronics.finishing import padding, record_length
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, blocks
from cpunet.pulses.parameters import current_amplitude, tail_slope

MIN_PULSES = 50  # of either dataset, for a fit
TAIL_SHARE = 0.75  # of the time after the alignment: 4.8 of 6.4 us, as in the paper
LONGEST_NS = 1024.0  # maximum sigma and tau
TOLERANCE = 1e-3  # precision of its tau, in samples


@dataclass(frozen=True, eq=False)
class BaselineMethod:
    r"""A baseline method: a causal linear response fitted to unpaired pulses.

    The current of a pulse is convolved with a kernel. Each step of the charge then decays,

    .. math:: s_j = e^{\lambda \Delta t} s_{j-1} + x_j

    with the logarithmic slope :math:`\lambda` of the tail.

    Parameters
    ----------
    dt_ns
        Sampling period in ns of the pulses in the fit.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms, negative for a decay.
    transfer
        Transfer function of the kernel at the frequencies of a record, see `currents`.
    values
        Fitted values of the kernel by name. Each name ends with the unit.

    Examples
    --------
    Without a kernel, a step decays exponentially.

    >>> step = (np.arange(800) >= 400)[np.newaxis].astype(np.float32)
    >>> method = BaselineMethod(16.0, -20.0, np.ones(1), {})
    >>> tail = method.translate(step)[0, padding(16.0)[0] + 400 :]
    >>> bool(abs(tail[100] / tail[0] - np.exp(-1.6 / 50)) < 1e-6)  # a decay time of 50 us
    True
    """

    dt_ns: float
    tail_slope_per_ms: float
    transfer: Spectrum
    values: Mapping[str, float]

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Noise-free response to simulated windows.

        Returns
        -------
        numpy.ndarray
            Records with padding on both sides of the window, float32, neither aligned nor
            normalised. `finishing.finish` converts them into windows.
        """
        length = record_length(waveforms.shape[1], self.dt_ns)
        remaining = np.exp(self.tail_slope_per_ms * self.dt_ns * 1e-6)
        records = np.empty((len(waveforms), length), np.float32)
        for rows in blocks(len(waveforms)):
            spectrum = scipy.fft.rfft(currents(waveforms[rows], self.dt_ns), axis=1)
            current = scipy.fft.irfft(spectrum * self.transfer, length, axis=1)
            records[rows] = scipy.signal.lfilter([1.0], [1.0, -remaining], current, axis=1)
        return records

    def describe(self) -> Mapping[str, float]:
        """Fitted values by name."""
        return {**self.values, "tail_slope_per_ms": self.tail_slope_per_ms}


def currents(windows: FloatArray, dt_ns: float) -> Values:
    """Charge collected per sample over the whole record, shape ``(n, record)``."""
    n, length = windows.shape
    record, (before, _) = np.zeros((n, record_length(length, dt_ns))), padding(dt_ns)
    record[:, before : before + length] = np.diff(windows.astype(float), axis=1, prepend=0.0)
    return record


Kernel = tuple[Spectrum, dict[str, float]]
"""Transfer function at the frequencies of a record, and fitted values by name."""


def fitted(
    fit: Callable[[FloatArray, FloatArray, float], Kernel],
    most: int,
    sim: FloatArray,
    data: FloatArray,
    dt_ns: float,
    align: int,
    *,
    late: bool = False,
) -> BaselineMethod:
    r"""Fit the decay, and a kernel to the data without it (pole-zero correction).

    .. math:: x_j = \sum_{k \le j} \left(s_k - e^{\lambda \Delta t} s_{k-1}\right)

    with the median logarithmic slope :math:`\lambda` of the tails.

    Parameters
    ----------
    fit
        Fit of the kernel to simulated windows and data without decay, both of unit height, and
        their sampling period in ns.
    most
        Number of pulses at most of either side that are compared.
    sim, data
        Prepared windows, shape ``(n, length)``. Simulated ones range from 0 to 1.
    dt_ns
        Sampling period in ns.
    align
        Sample at which both are aligned.
    late
        Whether the kernel has a late part, which contributes to the tail.

    Raises
    ------
    CpunetError
        If a side has too few pulses, or no tail is positive, or the fit of the kernel fails.
    """
    for side, windows in (("simulated", sim), ("measured", data)):
        if len(windows) < MIN_PULSES:
            raise CpunetError(
                f"{len(windows)} {side} pulses; give {MIN_PULSES} or more to fit a response to"
            )
    length = data.shape[1]
    late_samples = max(3, int(TAIL_SHARE * (length - align)))  # contain only the decay

    def slope_of(windows: FloatArray) -> float:
        slopes = tail_slope(windows, dt_ns, late_samples)
        slopes = slopes[np.isfinite(slopes)]
        if not slopes.size:
            raise CpunetError("no measured pulse has a positive tail; check their polarity")
        return float(np.median(slopes))

    slope = slope_of(data)
    current = data[:most].astype(float)
    current[:, 1:] -= np.exp(slope * dt_ns * 1e-6) * data[:most, :-1]
    steps = np.cumsum(current, axis=1)
    heights = steps[:, -late_samples:].mean(axis=1, keepdims=True)
    transfer, values = fit(sim[:most], (steps / heights).astype(np.float32), dt_ns)
    method, before = BaselineMethod(dt_ns, slope, transfer, values), padding(dt_ns)[0]
    if not late:
        return method
    added = slope_of(method.translate(sim[:most])[:, before : before + length]) - slope
    return replace(method, tail_slope_per_ms=slope - added)


def fit_rc(sim: FloatArray, steps: FloatArray, dt_ns: float) -> Kernel:
    r"""A single RC integration: match the mode of the current amplitudes.

    .. math:: s_j = s_{j-1} + (x_{j-1} - s_{j-1})\, \Delta t / \tau

    as in siggen, with :math:`\tau` of at least one sampling period. For the parameters see
    `fitted`.

    Raises
    ------
    CpunetError
        If the data are slower than the maximum tau.
    """
    wanted = most_frequent(current_amplitude(steps, dt_ns))
    before, current = padding(dt_ns)[0], currents(sim, dt_ns)
    window, longest = slice(before, before + sim.shape[1]), LONGEST_NS / dt_ns

    def excess(tau: float) -> float:
        slower = scipy.signal.lfilter([0.0, 1 / tau], [1.0, 1 / tau - 1.0], current)
        response = np.cumsum(slower, axis=1)[:, window]
        return most_frequent(current_amplitude(response.astype(np.float32), dt_ns)) - wanted

    if excess(1.0) <= 0:
        tau_ns = dt_ns  # the data rise faster than the simulation: any integration is worse
    elif excess(longest) > 0:
        raise CpunetError(
            f"measured pulses rise slower than behind {LONGEST_NS:g} ns; check both periods"
        )
    else:
        tau_ns = dt_ns * float(scipy.optimize.brentq(excess, 1.0, longest, xtol=TOLERANCE))
    rate, delay = dt_ns / tau_ns, np.exp(-2j * np.pi * scipy.fft.rfftfreq(current.shape[1]))
    return np.asarray(rate * delay / (1 + (rate - 1) * delay)), {"tau_ns": tau_ns}


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
