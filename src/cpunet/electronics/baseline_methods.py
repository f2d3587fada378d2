"""Baseline methods a user would choose instead of a network, fitted to the same datasets.

Each is a linear response applied to windows: a kernel on the current, then the decay. A window
is padded before the response is applied. No charge moves before the window, and all is
collected by its end, so the current is zero on both sides. The padding holds the parts of the
response outside the window and allows the window to be cut again after a later alignment.

RC is fitted to current amplitudes, the others to superpulses: mean currents of pulses with
similar rise times, aligned at half maximum. Simulated and measured pulses are of different
events, so single pulses cannot be compared. Their means can, once both datasets are divided at
the same quantiles of rise time. Pulses of one slice then originate from the same regions of
the detector.

`gauss_exp` is the kernel of LEGEND's production: sigma and tau are fitted to the
superpulses. `fit_superpulse` divides their spectra. In each slice the mean measured current is
the mean simulated one convolved with the kernel. The transfer function of the kernel is
therefore the ratio of their spectra, H = sum(D S*) / sum(|S|^2) over the slices. A Wiener
factor suppresses H where the measured spectrum does not exceed its statistical error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.optimize
import scipy.signal

from cpunet.electronics.chain import ComplexArray as Spectrum
from cpunet.electronics.chain import FloatArray as Values
from cpunet.electronics.finishing import padding, record_length
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, blocks
from cpunet.pulses.parameters import crossings, current_amplitude, shorth, tail_slope

MIN_PULSES = 50  # of either dataset, for a fit
TAIL_SHARE = 0.75  # of the time after the alignment: 4.8 of 6.4 us, as in the paper
LONGEST_NS = 1024.0  # maximum sigma and tau
TOLERANCE = 1e-3  # precision of the tau of RC, in samples
SLICES = 8
SINGLE_SITE = 0.35  # fraction of the pulses of a slice that is used
RISE_START, RISE_END = 0.02, 0.95  # above the noise at the start, below the slow top
FITTED_ROUNDS = 3  # of the fit of parameters, each with slices from the response fitted so far
EDGE_NS = 1536.0  # time compared before and after the half maximum
FREE_ROUNDS = 4  # of the free kernel, each with half maxima of the response so far
# The kernel before and after the half maximum, and where its ends are tapered.
LEAD_NS, LAG_NS = 512.0, 4096.0
FADE_IN_NS, FADE_OUT_NS = 128.0, 1024.0


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
    transfer
        Transfer function of the kernel at the frequencies of a record, see `currents`.
    values
        Fitted values by name, which ends with the unit: those of the kernel, and
        ``tail_slope_per_ms``, the logarithmic slope of the tail, negative for a decay.

    Examples
    --------
    Without a kernel, a step decays exponentially.

    >>> step = (np.arange(800) >= 400)[np.newaxis].astype(np.float32)
    >>> method = BaselineMethod(16.0, np.ones(1), {"tail_slope_per_ms": -20.0})
    >>> tail = method.translate(step)[0, padding(16.0)[0] + 400 :]
    >>> bool(abs(tail[100] / tail[0] - np.exp(-1.6 / 50)) < 1e-6)  # a decay time of 50 us
    True
    """

    dt_ns: float
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
        remaining = np.exp(self.values["tail_slope_per_ms"] * self.dt_ns * 1e-6)
        records = np.empty((len(waveforms), length), np.float32)
        for rows in blocks(len(waveforms)):
            spectrum = scipy.fft.rfft(currents(waveforms[rows], self.dt_ns), axis=1)
            current = scipy.fft.irfft(spectrum * self.transfer, length, axis=1)
            records[rows] = scipy.signal.lfilter([1.0], [1.0, -remaining], current, axis=1)
        return records


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
    values["tail_slope_per_ms"] = slope
    method, before = BaselineMethod(dt_ns, transfer, values), padding(dt_ns)[0]
    if late:
        added = slope_of(method.translate(sim[:most])[:, before : before + length]) - slope
        values["tail_slope_per_ms"] = slope - added
    return method


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
    wanted = shorth(current_amplitude(steps, dt_ns))
    before, current = padding(dt_ns)[0], currents(sim, dt_ns)
    window, longest = slice(before, before + sim.shape[1]), LONGEST_NS / dt_ns

    def excess(tau: float) -> float:
        slower = scipy.signal.lfilter([0.0, 1 / tau], [1.0, 1 / tau - 1.0], current)
        response = np.cumsum(slower, axis=1)[:, window]
        return shorth(current_amplitude(response.astype(np.float32), dt_ns)) - wanted

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


def crossing(steps: Values, fraction: float) -> Values:
    """Sample at which each pulse of unit height last rises through a fraction.

    The sample is interpolated linearly. It is NaN if there is no crossing before `RISE_END`.

    Examples
    --------
    >>> crossing(np.array([[0.0, 0.0, 0.4, 0.8, 1.0, 1.0]]), 0.5)
    array([2.25])
    """
    top = (steps >= RISE_END).argmax(axis=1)
    return crossings(steps, np.full(len(steps), fraction), top)


def slices(current: Values) -> list[npt.NDArray[np.int64]]:
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
        text = f"only {len(rows)} of {len(current)} pulses rise from baseline to top"
        raise CpunetError(text, "check that they are prepared charge pulses")
    # Over three samples, the peak hardly depends on the sampling phase.
    height = (current[:, :-2] + current[:, 1:-1] + current[:, 2:]).max(axis=1)
    ordered = rows[np.argsort(rise[rows], kind="stable")]
    groups = np.array_split(ordered, SLICES)
    return [g[np.argsort(height[g])[-int(np.ceil(SINGLE_SITE * len(g))) :]] for g in groups]


def aligned(spectra: Spectrum, response: Values) -> Spectrum:
    r"""Current spectra of pulses, with the half maximum of each at sample 0.

    .. math:: X_{pk}\, e^{2 \pi i k t_p / N}

    with the half maximum :math:`t_p` of pulse :math:`p` in samples.

    Parameters
    ----------
    spectra
        Spectra of the currents, shape ``(n, length // 2 + 1)``.
    response
        The currents that align the pulses, shape ``(n, length)``.
    """
    (n, length), bins = response.shape, spectra.shape[1]
    times = crossing(np.cumsum(response, axis=1), 0.5)[:, np.newaxis] * (2j * np.pi / length)
    # the phase of bin a + root b is the product of two: far fewer exponentials
    root = int(np.ceil(np.sqrt(bins)))
    fine, coarse = (np.exp(times * step * np.arange(root)) for step in (1, root))
    phases = coarse[:, :, np.newaxis] * fine[:, np.newaxis]
    return np.asarray(spectra * phases.reshape(n, -1)[:, :bins])


def gauss_exp(s: Spectrum, sigma_ns: float, tau_ns: float) -> Spectrum:
    r"""A Gaussian and an exponential, at :math:`s = i \omega` in 1/ns.

    .. math:: H(\omega) = \frac{e^{-\sigma^2 \omega^2 / 2}}{1 + i \omega \tau}
    """
    return np.asarray(np.exp(-0.5 * (s.imag * sigma_ns) ** 2) / (1 + s * tau_ns))


def rc_late(s: Spectrum, tau_ns: float, late_share: float, late_ns: float) -> Spectrum:
    r"""An RC integration with a part of the charge that comes late, at :math:`s = i \omega`.

    .. math:: H(\omega) = \frac{1}{1 + i \omega \tau}
        \left(1 - w + \frac{w}{1 + i \omega T}\right)

    with the share :math:`w` of the late charge and its time constant :math:`T`.
    """
    late = late_share / (1 + s * late_ns)
    return np.asarray((1 - late_share + late) / (1 + s * tau_ns))


def fit_kernel(
    transfer: Callable[..., Spectrum],
    parameters: Mapping[str, tuple[float, float, float]],
    sim: FloatArray,
    steps: FloatArray,
    dt_ns: float,
    *,
    late: bool = False,
) -> Kernel:
    r"""A kernel with parameters, fitted to superpulses.

    Parameters
    ----------
    transfer
        Transfer function: a function of :math:`i \omega` in 1/ns and the parameters.
    parameters
        Where each starts, its largest value (the smallest is 0), and its scale, by name.
    sim, steps, dt_ns
        See `fitted`.
    late
        Whether a part of the charge comes late. It counts for little in currents, so charges
        are compared.
    """
    best, high, scale = np.transpose([*parameters.values()])
    current = currents(steps, dt_ns)
    of_data, of_sim = (scipy.fft.rfft(of) for of in (current, currents(sim, dt_ns)))
    length, edge = current.shape[1], round(EDGE_NS / dt_ns)
    s = 2e-3j * np.pi * scipy.fft.rfftfreq(length, 1e-3 * dt_ns)  # 1/ns

    def mean_currents(parts: Sequence[Spectrum], kernel: Spectrum | float = 1.0) -> Values:
        """Mean currents of slices around the half maximum, shape ``(slices, 2 * edge)``."""
        behind = [part * kernel for part in parts]
        moved = [aligned(part, scipy.fft.irfft(part, length, axis=1)) for part in behind]
        means = np.array([part.mean(axis=0) for part in moved])
        around = np.roll(scipy.fft.irfft(means, length, axis=1), edge, axis=1)
        return np.asarray(around[:, : 2 * edge], float)

    def residual(at: Values) -> Values:
        off = mean_currents(sliced, transfer(s, *at)) - wanted
        return np.asarray(np.cumsum(off, axis=1) if late else off).ravel()

    wanted = mean_currents([of_data[rows] for rows in slices(current)])
    how = {"x_scale": scale, "diff_step": 1e-3, "xtol": 1e-4}
    for _ in range(FITTED_ROUNDS):
        response = scipy.fft.irfft(of_sim * transfer(s, *best), length, axis=1)
        sliced = [of_sim[rows] for rows in slices(response)]
        best = scipy.optimize.least_squares(residual, best, bounds=(0.0, high), **how).x
    return transfer(s, *best), dict(zip(parameters, best.tolist(), strict=True))


def fit_superpulse(sim: FloatArray, steps: FloatArray, dt_ns: float) -> Kernel:
    r"""A free kernel: `LEAD_NS` before zero delay and `LAG_NS` from it on, with a sum of 1.

    .. math:: H = W \frac{\sum D S^*}{\sum (|S|^2 + \sigma_S^2)}, \qquad
        W = \max\left(0, 1 - \frac{\sum \sigma_D^2}{\sum |D|^2}\right)

    The sums run over the slices. :math:`D` and :math:`S` are the mean spectra of data and
    simulation, :math:`\sigma_D` and :math:`\sigma_S` their statistical errors. For the
    parameters see `fitted`.
    """
    current = currents(steps, dt_ns)
    of_data, of_sim = (scipy.fft.rfft(of) for of in (current, currents(sim, dt_ns)))
    transfer, length = np.ones(of_sim.shape[1], complex), current.shape[1]

    def mean_spectra(spectra: Spectrum, response: Values) -> tuple[Spectrum, Values]:
        """Mean spectrum of each slice, and its squared standard error.

        The error includes noise and the differences between pulses within a slice.
        """
        moved = [aligned(spectra[rows], response[rows]) for rows in slices(response)]
        error = np.array([part.var(axis=0) / max(1, len(part) - 1) for part in moved])
        return np.array([part.mean(axis=0) for part in moved]), error

    measured, data_error = mean_spectra(of_data, current)
    wiener = np.clip(1 - data_error.sum(axis=0) / (np.abs(measured) ** 2).sum(axis=0), 0, 1)
    times_ns = LEAD_NS, LAG_NS, FADE_IN_NS, FADE_OUT_NS
    lead, lag, fade_in, fade_out = (round(time / dt_ns) for time in times_ns)
    phase = 0.5 * np.pi * (np.arange(lead + lag) + 0.5)
    phase = np.minimum(phase / fade_in, phase[::-1] / fade_out)
    fades = np.sin(phase.clip(max=0.5 * np.pi)) ** 2
    for _ in range(FREE_ROUNDS):
        # The simulated pulses are placed by the half maximum of their response. A shift
        # of their own half maximum does not give this exactly.
        response = scipy.fft.irfft(of_sim * transfer, length, axis=1)
        simulated, sim_error = mean_spectra(of_sim, response)
        below = (np.abs(simulated) ** 2 + sim_error).sum(axis=0)
        ratio = wiener * (measured * simulated.conj()).sum(axis=0) / below
        kernel = np.roll(scipy.fft.irfft(ratio, length), lead)[: lead + lag] * fades
        kernel /= kernel.sum()
        around_zero = np.roll(np.pad(kernel, (0, length - len(kernel))), -lead)
        transfer = np.asarray(scipy.fft.rfft(around_zero))
    return transfer, {}


# Where parameters start, their largest values, and their scales.
_WIDTH = 32.0, LONGEST_NS, LONGEST_NS
_GAUSS_EXP = {"sigma_ns": _WIDTH, "tau_ns": _WIDTH}
_RC_LATE = {"tau_ns": _WIDTH, "late_share": (0.05, 0.5, 1.0)}
_RC_LATE["late_ns"] = 400.0, 4 * LONGEST_NS, LONGEST_NS
_rc_late = partial(fit_kernel, rc_late, _RC_LATE, late=True)
BASELINE_METHODS = {
    "rc": partial(fitted, fit_rc, 4000),
    "rc_late": partial(fitted, _rc_late, 2000, late=True),
    "gauss_exp": partial(fitted, partial(fit_kernel, gauss_exp, _GAUSS_EXP), 2000),
    "superpulse": partial(fitted, fit_superpulse, 4000, late=True),
}
