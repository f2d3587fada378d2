"""Kernels fitted to superpulses: RC with late charge, Gaussian with exponential, a free one.

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

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.optimize

from cpunet.electronics.baseline_methods import (
    LONGEST_NS,
    RC,
    BaselineMethod,
    Spectrum,
    Values,
    currents,
    fitted_decay,
    fitted_tail_slope,
    respond,
)
from cpunet.electronics.finishing import padding, record_length
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import last_below

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
