"""Kernels fitted to superpulses: RC with late charge, Gaussian with exponential, a free one.

Superpulses are mean currents of pulses with similar rise times, aligned at half maximum.
Simulated and measured pulses are of different events, so single pulses cannot be compared.
Their means can, once both datasets are divided at the same quantiles of rise time. Pulses of
one slice then originate from the same regions of the detector.

`fit_gauss_exp` is the method of LEGEND's production: sigma and tau are fitted to the
superpulses. `fit_superpulse` divides their spectra. In each slice the mean measured current is
the mean simulated one convolved with the kernel. The transfer function of the kernel is
therefore the ratio of their spectra, H = sum(D S*) / sum(|S|^2) over the slices. A Wiener
factor suppresses H where the measured spectrum does not exceed its statistical error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.optimize

from cpunet.electronics.baseline_methods import (
    LONGEST_NS,
    BaselineMethod,
    Spectrum,
    Values,
    currents,
    fit_rc,
    fitted_decay,
    fitted_tail_slope,
)
from cpunet.electronics.finishing import padding, record_length
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import last_below

Groups = list[npt.NDArray[np.int64]]

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
    last = last_below(steps, top, np.full(len(steps), fraction))
    crossed, last = last >= 0, np.minimum(last, steps.shape[1] - 2)
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


def superpulses(spectra: Spectrum, response: Values) -> tuple[Spectrum, Values]:
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


# maximum number of pulses of either dataset in the fit of parameters, and its iterations,
# each with slices from the response fitted so far
FITTED_PULSES, FITTED_ROUNDS = 2000, 3
# Time compared before and after the half maximum; initial sigma and tau.
EDGE_NS, START_NS = 1536.0, 32.0
START_SHARE, LATE_NS = 0.05, 400.0  # the same of the late charge


def fit_gauss_exp(
    sim: FloatArray, data: FloatArray, dt_ns: float, align: int
) -> BaselineMethod:
    r"""A Gaussian and an exponential kernel, fitted to superpulses.

    .. math:: H(\omega) = \frac{e^{-\sigma^2 \omega^2 / 2}}{1 + i \omega \tau}

    For the parameters see `fitted_decay`.
    """
    scale = {"sigma_ns": LONGEST_NS, "tau_ns": LONGEST_NS}
    high, start = np.full(2, LONGEST_NS), np.full(2, START_NS)
    return _fitted(sim, data, dt_ns, align, gauss_exp, start, high, scale)


def gauss_exp(dt_ns: float, sigma_ns: float, tau_ns: float, length: int) -> Spectrum:
    """Transfer function of `fit_gauss_exp` at the frequencies of a record."""
    omega = 2e-3 * np.pi * scipy.fft.rfftfreq(length, 1e-3 * dt_ns)  # 1/ns
    gauss = np.exp(-0.5 * (omega * sigma_ns) ** 2)
    return np.asarray(gauss / (1 + 1j * omega * tau_ns), complex)


def fit_rc_late(sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> BaselineMethod:
    r"""An RC integration with a part of the charge that comes late, fitted to superpulses.

    .. math:: H(\omega) = \frac{1}{1 + i \omega \tau}
        \left(1 - w + \frac{w}{1 + i \omega T}\right)

    with the share :math:`w` of the late charge and its time constant :math:`T`. Charges are
    compared, since late charge counts for little in currents. For the parameters see
    `fitted_decay`.
    """
    scale = {"tau_ns": LONGEST_NS, "late_share": 1.0, "late_ns": LONGEST_NS}
    start = np.array([START_NS, START_SHARE, LATE_NS])
    high = np.array([LONGEST_NS, 0.5, 4 * LONGEST_NS])
    method = _fitted(sim, data, dt_ns, align, rc_late, start, high, scale, charge=True)
    return _with_own_decay(method, sim[:FITTED_PULSES], align)


def rc_late(
    dt_ns: float, tau_ns: float, late_share: float, late_ns: float, length: int
) -> Spectrum:
    """Transfer function of `fit_rc_late` at the frequencies of a record."""
    s = 2e-3j * np.pi * scipy.fft.rfftfreq(length, 1e-3 * dt_ns)  # 1/ns
    late = late_share / (1 + s * late_ns)
    return np.asarray((1 - late_share + late) / (1 + s * tau_ns), complex)


def _fitted(
    sim: FloatArray,
    data: FloatArray,
    dt_ns: float,
    align: int,
    transfer: Callable[..., Spectrum],
    best: Values,
    high: Values,
    scale: Mapping[str, float],
    *,
    charge: bool = False,
) -> BaselineMethod:
    """A method whose kernel has parameters, fitted to superpulses.

    Parameters
    ----------
    sim, data, dt_ns, align
        See `fitted_decay`.
    transfer
        Transfer function: a function of the period in ns, the parameters and the length.
    best, high, scale
        Where the parameters start, their largest values (the smallest are 0), and their
        scales by name.
    charge
        Compare charges in place of currents.
    """
    slope, steps = fitted_decay(sim, data, dt_ns, align, FITTED_PULSES)
    measured, edge = currents(steps, dt_ns), round(EDGE_NS / dt_ns)
    length = record_length(sim.shape[1], dt_ns)

    def mean_currents(spectra: Spectrum, groups: Groups) -> Values:
        """Superpulses of currents around the half maximum, shape ``(slices, 2 * edge)``."""
        steps = np.cumsum(scipy.fft.irfft(spectra, length, axis=1), axis=1)
        means = [moved.mean(axis=0) for moved in _aligned(spectra, steps, groups)]
        around = np.roll(scipy.fft.irfft(np.array(means), length, axis=1), edge, axis=1)
        return np.asarray(around[:, : 2 * edge], float)

    of_data = np.asarray(scipy.fft.rfft(measured, axis=1), complex)
    wanted = mean_currents(of_data, slices(measured))
    spectra = np.asarray(scipy.fft.rfft(currents(sim[:FITTED_PULSES], dt_ns), axis=1), complex)
    for _ in range(FITTED_ROUNDS):
        response = spectra * transfer(dt_ns, *best, length)
        groups = slices(scipy.fft.irfft(response, length, axis=1))
        # pulses outside the slices do not enter the fit
        sliced = spectra[np.concatenate(groups)]
        ends = np.cumsum([len(group) for group in groups])
        places = np.split(np.arange(ends[-1]), ends[:-1])

        def residual(
            parameters: Values, sliced: Spectrum = sliced, places: Groups = places
        ) -> Values:
            off = mean_currents(sliced * transfer(dt_ns, *parameters, length), places) - wanted
            return np.asarray(np.cumsum(off, axis=1) if charge else off).ravel()

        best = scipy.optimize.least_squares(
            residual,
            best,
            bounds=(0.0, high),
            x_scale=[*scale.values()],
            diff_step=1e-3,
            xtol=1e-4,
        ).x
    values = dict(zip(scale, best.tolist(), strict=True))
    return BaselineMethod(dt_ns, slope, partial(transfer, dt_ns, *values.values()), values)


def _with_own_decay(method: BaselineMethod, sim: FloatArray, align: int) -> BaselineMethod:
    """A method whose decay lacks what a kernel's late part contributes to the tail."""
    before, slope = padding(method.dt_ns)[0], method.tail_slope_per_ms
    windows = method.translate(sim)[:, before : before + sim.shape[1]]
    added = fitted_tail_slope(windows, method.dt_ns, align) - slope
    return replace(method, tail_slope_per_ms=slope - added)


# the same of the free kernel, whose iterations take half maxima of the response so far
FREE_PULSES, FREE_ROUNDS = 4000, 4
# The kernel before and after the half maximum, and where its ends are tapered.
LEAD_NS, LAG_NS = 512.0, 4096.0
FADE_IN_NS, FADE_OUT_NS = 128.0, 1024.0


def fit_superpulse(
    sim: FloatArray, data: FloatArray, dt_ns: float, align: int
) -> BaselineMethod:
    r"""A free kernel: `LEAD_NS` before zero delay and `LAG_NS` from it on, with a sum of 1.

    .. math:: H = W \frac{\sum D S^*}{\sum (|S|^2 + \sigma_S^2)}, \qquad
        W = \max\left(0, 1 - \frac{\sum \sigma_D^2}{\sum |D|^2}\right)

    The sums run over the slices. :math:`D` and :math:`S` are the mean spectra of data and
    simulation, :math:`\sigma_D` and :math:`\sigma_S` their statistical errors. For the
    parameters see `fitted_decay`.
    """
    slope, steps = fitted_decay(sim, data, dt_ns, align, FREE_PULSES)
    length, current = record_length(sim.shape[1], dt_ns), currents(steps, dt_ns)
    measured, data_error = superpulses(np.asarray(scipy.fft.rfft(current, axis=1)), current)
    wiener = np.clip(1 - data_error.sum(axis=0) / (np.abs(measured) ** 2).sum(axis=0), 0, 1)
    lead, lag, fade_in, fade_out = (
        round(time / dt_ns) for time in (LEAD_NS, LAG_NS, FADE_IN_NS, FADE_OUT_NS)
    )
    fades = np.ones(lead + lag)
    fades[:fade_in] = np.sin(0.5 * np.pi * (np.arange(fade_in) + 0.5) / fade_in) ** 2
    fall = np.sin(0.5 * np.pi * (np.arange(fade_out) + 0.5) / fade_out) ** 2
    fades[-fade_out:] = fall[::-1]

    spectra = np.asarray(scipy.fft.rfft(currents(sim[:FREE_PULSES], dt_ns), axis=1))
    kernel = np.zeros(lead + lag)
    kernel[lead] = 1.0
    for _ in range(FREE_ROUNDS):
        # The simulated pulses are placed by the half maximum of their response. A shift
        # of their own half maximum does not give this exactly.
        response = scipy.fft.irfft(spectra * free(kernel, lead, length), length, axis=1)
        simulated, sim_error = superpulses(spectra, response)
        below = (np.abs(simulated) ** 2 + sim_error).sum(axis=0)
        ratio = wiener * (measured * simulated.conj()).sum(axis=0) / below
        kernel = np.roll(scipy.fft.irfft(ratio, length), lead)[: lead + lag] * fades
        kernel /= kernel.sum()
    time_ns = np.arange(len(kernel)) * dt_ns
    mean_ns = float(kernel @ time_ns)
    variance = float(kernel @ (time_ns - mean_ns) ** 2)
    values = {
        "kernel_mean_ns": mean_ns - LEAD_NS,
        "kernel_rms_ns": float(np.sqrt(max(variance, 0.0))),
    }
    method = BaselineMethod(dt_ns, slope, partial(free, kernel, lead), values)
    return _with_own_decay(method, sim[:FREE_PULSES], align)


def free(kernel: Values, lead: int, length: int) -> Spectrum:
    """Transfer function of a kernel that begins `lead` samples before zero delay."""
    around_zero = np.zeros(length)
    around_zero[: len(kernel)] = kernel
    return np.asarray(scipy.fft.rfft(np.roll(around_zero, -lead)), complex)


Fit = Callable[[FloatArray, FloatArray, float, int], BaselineMethod]
BASELINE_METHODS: dict[str, Fit] = {
    "rc": fit_rc,
    "rc_late": fit_rc_late,
    "gauss_exp": fit_gauss_exp,
    "superpulse": fit_superpulse,
}
