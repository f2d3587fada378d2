"""Baseline methods a user would choose instead of a network, fitted to the same datasets.

Each is a linear response applied to windows: a kernel on the current, then the decay. A window
is padded before the response is applied. No charge moves before the window, and all is
collected by its end, so the current is zero on both sides. The padding holds the parts of the
response outside the window and allows the window to be cut again after a later alignment.

Kernels fitted to superpulses: RC with late charge, Gaussian with exponential, a free one.

Superpulses are mean currents of pulses with similar rise times, aligned at half maximum.
Simulated and measured pulses are of different events, so single pulses cannot be compared.
Their means can, once both datasets are divided at the same quantiles of rise time. Pulses of
one slice then originate from the same regions of the detector.

`GaussExp` is the method of LEGEND's production: sigma and tau are fitted to the superpulses.
`SuperpulseKernel` divides their spectra. In each slice the mean measured current is the mean
simulated one convolved with the kernel. The transfer function of the kernel is therefore the
ratio of their spectra, H = sum(D S*) / sum(|S|^2) over the slices. A Wiener factor suppresses H
where the measured spectrum does not exceed its statistical error.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.optimize
import scipy.signal

from cpunet.electronics.finishing import padding, record_length
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, blocks
from cpunet.pulses.parameters import current_amplitude, last_below, tail_slope

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


Groups = list[npt.NDArray[np.int64]]
Superpulses = tuple[Spectrum, Values]  # see `superpulses`

SLICES = 8
SINGLE_SITE = 0.35  # fraction of the pulses of a slice that is used
RISE_START, RISE_END = 0.02, 0.95  # above the noise at the start, below the slow top


def crossing(steps: Values, fraction: float) -> Values:
    """Sample at which each pulse of unit height last rises through a fraction.

    The sample is interpolated linearly. It is NaN if there is no crossing before `RISE_END`.

    Examples
    --------
    >>> crossing(np.array([[0.0, 0.0, 0.4, 0.8, 1.0, 1.0]]), 0.5)
    array([2.25])
    """
    top = (steps >= RISE_END).argmax(axis=1)
    crossed, last = last_below(steps, top, np.full(len(steps), fraction))
    last = np.minimum(last, steps.shape[1] - 2)
    rows = np.arange(len(steps))
    low, high = steps[rows, last], steps[rows, last + 1]
    rise = np.where(crossed, high - low, 1.0)
    return np.asarray(np.where(crossed, last + (fraction - low) / rise, np.nan), float)


def slices(current: Values) -> Groups:
    """Rows of single-site-like pulses between quantiles of rise time.

    The pulses with the highest current in each slice are used. They differ far less from
    each other than multi-site pulses, and so do their means between datasets.

    Parameters
    ----------
    current
        Currents of pulses of unit height, shape ``(n, length)``.

    Raises
    ------
    CpunetError
        If too few pulses rise from baseline to top.
    """
    steps = np.cumsum(current, axis=1)
    rise = crossing(steps, RISE_END) - crossing(steps, RISE_START)
    rows = np.flatnonzero(np.isfinite(rise))
    if len(rows) < 2 * SLICES / SINGLE_SITE:
        raise CpunetError(
            f"only {len(rows)} of {len(current)} pulses rise from baseline to top; "
            "check that they are prepared charge pulses"
        )
    # Over three samples, the peak hardly depends on the sampling phase.
    height = (current[:, :-2] + current[:, 1:-1] + current[:, 2:]).max(axis=1)
    ordered = rows[np.argsort(rise[rows], kind="stable")]
    return [
        group[np.argsort(height[group])[-int(np.ceil(SINGLE_SITE * len(group))) :]]
        for group in np.array_split(ordered, SLICES)
    ]


def superpulses(spectra: Spectrum, response: Values) -> Superpulses:
    r"""Mean current spectra by slice, with the half maximum of each pulse at sample 0.

    .. math:: \bar{X}_k = \frac{1}{n} \sum_p X_{pk}\, e^{2 \pi i k t_p / N}

    with the half maximum :math:`t_p` of pulse :math:`p` in samples.

    Parameters
    ----------
    spectra
        Spectra of the currents, shape ``(n, length // 2 + 1)``.
    response
        The currents that slice and align the pulses.

    Returns
    -------
    means, error
        Shape ``(slices, frequencies)``; the error is the squared standard error of the mean,
        with noise and the differences between pulses within a slice.
    """
    groups = slices(response)
    means = np.empty((len(groups), spectra.shape[1]), complex)
    error = np.empty(means.shape)
    for k, moved in enumerate(_aligned(spectra, np.cumsum(response, axis=1), groups)):
        means[k] = moved.mean(axis=0)
        error[k] = moved.var(axis=0) / max(1, len(moved) - 1)
    return means, error


def _aligned(spectra: Spectrum, steps: Values, groups: Groups) -> Iterator[Spectrum]:
    """Current spectra of each slice, with the half maximum of each pulse at sample 0."""
    half_times, bins = crossing(steps, 0.5), spectra.shape[1]
    turn, root = 2j * np.pi / steps.shape[1], int(np.ceil(np.sqrt(bins)))
    for rows in groups:
        # the phase of bin a + root b is the product of two: far fewer exponentials
        times = half_times[rows, np.newaxis] * turn
        fine, coarse = (np.exp(times * step * np.arange(root)) for step in (1, root))
        phases = coarse[:, :, np.newaxis] * fine[:, np.newaxis]
        yield spectra[rows] * phases.reshape(len(rows), -1)[:, :bins]


# maximum number of pulses of either dataset in the fit of sigma and tau, and its iterations,
# each with slices from the response fitted so far
GAUSS_PULSES, GAUSS_ROUNDS = 2000, 3
# Time compared before and after the half maximum; initial sigma and tau.
EDGE_NS, START_NS = 1536.0, 32.0
START_SHARE, LATE_NS = 0.05, 400.0  # the same of the late charge


@dataclass(frozen=True)
class GaussExp(BaselineMethod):
    r"""A Gaussian and an exponential kernel followed by an exponential decay.

    .. math:: H(\omega) = \frac{e^{-\sigma^2 \omega^2 / 2}}{1 + i \omega \tau}

    Parameters
    ----------
    sigma_ns, tau_ns
        Standard deviation of the Gaussian and time constant of the exponential, in ns.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    """

    sigma_ns: float
    tau_ns: float
    tail_slope_per_ms: float
    name: ClassVar[str] = "gauss_exp"

    @classmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Fit superpulses in slices of rise time, see `BaselineMethod.fit`."""
        longest = np.full(2, LONGEST_NS)
        how = (np.full(2, START_NS), longest, longest)
        (sigma, tau), slope = _fitted(sim, data, dt_ns, align, _gauss_exp, how)
        return cls(dt_ns, sigma, tau, slope)

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Apply the kernel and the decay, see `BaselineMethod.translate`."""
        length = record_length(waveforms.shape[1], self.dt_ns)
        transfer = _gauss_exp(length, self.dt_ns, np.array([self.sigma_ns, self.tau_ns]))
        return respond(waveforms, transfer, self.tail_slope_per_ms, self.dt_ns)


@dataclass(frozen=True)
class RCLate(BaselineMethod):
    r"""An RC integration with a part of the charge that comes late, and a decay.

    .. math:: H(\omega) = \frac{1}{1 + i \omega \tau}
        \left(1 - w + \frac{w}{1 + i \omega T}\right)

    Parameters
    ----------
    tau_ns, late_share, late_ns
        Time constant of the integration, share :math:`w` of the late charge and its time
        constant :math:`T`, times in ns.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    """

    tau_ns: float
    late_share: float
    late_ns: float
    tail_slope_per_ms: float
    name: ClassVar[str] = "rc_late"

    @classmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Fit superpulses in slices of rise time, see `BaselineMethod.fit`."""
        start = np.array([START_NS, START_SHARE, LATE_NS])
        scale = np.array([LONGEST_NS, 1.0, LONGEST_NS])
        how = (start, np.array([LONGEST_NS, 0.5, 4 * LONGEST_NS]), scale)
        fitted = _fitted(sim, data, dt_ns, align, _rc_late, how, charge=True)
        (tau, share, late), slope = fitted
        method = cls(dt_ns, tau, share, late, slope)
        own = _own_decay(method, slope, sim[:GAUSS_PULSES], align)
        return replace(method, tail_slope_per_ms=own)

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Apply the kernel and the decay, see `BaselineMethod.translate`."""
        length = record_length(waveforms.shape[1], self.dt_ns)
        values = np.array([self.tau_ns, self.late_share, self.late_ns])
        transfer = _rc_late(length, self.dt_ns, values)
        return respond(waveforms, transfer, self.tail_slope_per_ms, self.dt_ns)


def _fitted(
    sim: FloatArray,
    data: FloatArray,
    dt_ns: float,
    align: int,
    kernel: Callable[[int, float, Values], Spectrum],
    how: tuple[Values, Values, Values],
    *,
    charge: bool = False,
) -> tuple[list[float], float]:
    """Parameters of a kernel fitted to superpulses, and the tail slope in 1/ms.

    Parameters
    ----------
    sim, data, dt_ns, align
        As of `BaselineMethod.fit`.
    kernel
        Fourier transform of the kernel at a length and a period in ns.
    how
        Where the parameters start, their largest values (the smallest are 0), and scales.
    charge
        Compare charges in place of currents, in which late charge counts for little.
    """
    slope, steps = fitted_decay(sim, data, dt_ns, align, GAUSS_PULSES)
    measured, edge = currents(steps, dt_ns), round(EDGE_NS / dt_ns)
    length = record_length(sim.shape[1], dt_ns)
    of_data = np.asarray(scipy.fft.rfft(measured, axis=1), complex)
    wanted = _mean_currents(of_data, slices(measured), length, edge)
    spectra = np.asarray(scipy.fft.rfft(currents(sim[:GAUSS_PULSES], dt_ns), axis=1), complex)

    best, high, scale = how
    for _ in range(GAUSS_ROUNDS):
        transfer = kernel(length, dt_ns, best)
        groups = slices(scipy.fft.irfft(spectra * transfer, length, axis=1))
        # pulses outside the slices do not enter the fit
        sliced = spectra[np.concatenate(groups)]
        ends = np.cumsum([len(group) for group in groups])
        places = np.split(np.arange(ends[-1]), ends[:-1])

        def residual(
            parameters: Values, sliced: Spectrum = sliced, places: Groups = places
        ) -> Values:
            response = sliced * kernel(length, dt_ns, parameters)
            off = _mean_currents(response, places, length, edge) - wanted
            return np.asarray(np.cumsum(off, axis=1) if charge else off).ravel()

        best = scipy.optimize.least_squares(
            residual, best, bounds=(0.0, high), x_scale=scale, diff_step=1e-3, xtol=1e-4
        ).x
    return best.tolist(), slope


def _rc_late(length: int, dt_ns: float, values: Values) -> Spectrum:
    """Fourier transform of the kernel of `RCLate` at the frequencies of a record."""
    s = 2e-3j * np.pi * scipy.fft.rfftfreq(length, 1e-3 * dt_ns)  # 1/ns
    tau, share, late = values
    return np.asarray((1 - share + share / (1 + s * late)) / (1 + s * tau), complex)


def _gauss_exp(length: int, dt_ns: float, values: Values) -> Spectrum:
    """Fourier transform of the kernel of `GaussExp` at the frequencies of a record."""
    sigma_ns, tau_ns = values
    omega = 2e-3 * np.pi * scipy.fft.rfftfreq(length, 1e-3 * dt_ns)  # 1/ns
    gauss = np.exp(-0.5 * (omega * sigma_ns) ** 2)
    return np.asarray(gauss / (1 + 1j * omega * tau_ns), complex)


def _mean_currents(spectra: Spectrum, groups: Groups, length: int, edge: int) -> Values:
    """Superpulses of currents around the half maximum, shape ``(slices, 2 * edge)``."""
    steps = np.cumsum(scipy.fft.irfft(spectra, length, axis=1), axis=1)
    means = [moved.mean(axis=0) for moved in _aligned(spectra, steps, groups)]
    around = np.roll(scipy.fft.irfft(np.array(means), length, axis=1), edge, axis=1)
    return np.asarray(around[:, : 2 * edge], float)


# the same of the free kernel, whose iterations take half maxima of the response so far
FREE_PULSES, FREE_ROUNDS = 4000, 4
# The kernel before and after the half maximum, and where its ends are tapered.
LEAD_NS, LAG_NS = 512.0, 4096.0
FADE_IN_NS, FADE_OUT_NS = 128.0, 1024.0


@dataclass(frozen=True, eq=False)
class SuperpulseKernel(BaselineMethod):
    r"""A free kernel followed by an exponential decay.

    .. math:: H = W \frac{\sum D S^*}{\sum (|S|^2 + \sigma_S^2)}, \qquad
        W = \max\left(0, 1 - \frac{\sum \sigma_D^2}{\sum |D|^2}\right)

    The sums run over the slices. :math:`D` and :math:`S` are the mean spectra of data and
    simulation, :math:`\sigma_D` and :math:`\sigma_S` their statistical errors.

    Parameters
    ----------
    kernel
        Weights with a sum of 1: `LEAD_NS` before zero delay and `LAG_NS` from it on.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    """

    kernel: Values
    tail_slope_per_ms: float
    name: ClassVar[str] = "superpulse"

    @classmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Divide the mean spectra, see `BaselineMethod.fit`."""
        slope, steps = fitted_decay(sim, data, dt_ns, align, FREE_PULSES)
        length, lead = record_length(sim.shape[1], dt_ns), round(LEAD_NS / dt_ns)
        current = currents(steps, dt_ns)
        wanted = superpulses(np.asarray(scipy.fft.rfft(current, axis=1)), current)

        spectra = np.asarray(scipy.fft.rfft(currents(sim[:FREE_PULSES], dt_ns), axis=1))
        kernel = np.zeros(lead + round(LAG_NS / dt_ns))
        kernel[lead] = 1.0
        for _ in range(FREE_ROUNDS):
            # The simulated pulses are placed by the half maximum of their response. A shift
            # of their own half maximum does not give this exactly.
            response = scipy.fft.irfft(
                spectra * _transfer(kernel, lead, length), length, axis=1
            )
            kernel = _kernel(wanted, superpulses(spectra, response), length, dt_ns)
        method = cls(dt_ns, kernel, slope)
        own = _own_decay(method, slope, sim[:FREE_PULSES], align)
        return replace(method, tail_slope_per_ms=own)

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Apply the kernel and the decay, see `BaselineMethod.translate`."""
        length = record_length(waveforms.shape[1], self.dt_ns)
        transfer = _transfer(self.kernel, round(LEAD_NS / self.dt_ns), length)
        return respond(waveforms, transfer, self.tail_slope_per_ms, self.dt_ns)

    def describe(self) -> Mapping[str, float]:
        """Mean and standard deviation of the kernel, and tail slope."""
        time = np.arange(len(self.kernel)) * self.dt_ns
        mean = float(self.kernel @ time)
        variance = float(self.kernel @ (time - mean) ** 2)
        return {
            "kernel_mean_ns": mean - LEAD_NS,
            "kernel_rms_ns": float(np.sqrt(max(variance, 0.0))),
            "tail_slope_per_ms": self.tail_slope_per_ms,
        }


def _own_decay(method: BaselineMethod, slope: float, sim: FloatArray, align: int) -> float:
    """Slope of the decay (1/ms) without what a kernel's late part contributes to the tail."""
    before = padding(method.dt_ns)[0]
    windows = method.translate(sim)[:, before : before + sim.shape[1]]
    return slope - (fitted_tail_slope(windows, method.dt_ns, align) - slope)


def _kernel(data: Superpulses, sim: Superpulses, length: int, dt_ns: float) -> Values:
    """Regularised ratio as weights around zero delay with a sum of 1."""
    (measured, data_error), (simulated, sim_error) = data, sim
    wiener = np.clip(1 - data_error.sum(axis=0) / (np.abs(measured) ** 2).sum(axis=0), 0, 1)
    below = (np.abs(simulated) ** 2 + sim_error).sum(axis=0)
    ratio = wiener * (measured * simulated.conj()).sum(axis=0) / below
    lead, lag, fade_in, fade_out = (
        round(time / dt_ns) for time in (LEAD_NS, LAG_NS, FADE_IN_NS, FADE_OUT_NS)
    )
    weights = np.roll(scipy.fft.irfft(ratio, length), lead)[: lead + lag]
    rise, fall = (
        np.sin(0.5 * np.pi * (np.arange(n) + 0.5) / n) ** 2 for n in (fade_in, fade_out)
    )
    weights[:fade_in] *= rise
    weights[-fade_out:] *= fall[::-1]
    return np.asarray(weights / weights.sum(), float)


def _transfer(kernel: Values, lead: int, length: int) -> Spectrum:
    around_zero = np.zeros(length)
    around_zero[: len(kernel)] = kernel
    return np.asarray(scipy.fft.rfft(np.roll(around_zero, -lead)), complex)


BASELINE_METHODS: dict[str, type[BaselineMethod]] = {
    method.name: method for method in (RC, RCLate, GaussExp, SuperpulseKernel)
}
