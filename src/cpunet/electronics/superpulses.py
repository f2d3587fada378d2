"""Kernels fitted to superpulses, and the table of all baseline methods.

Superpulses are mean currents of pulses with similar rise times, aligned at half maximum.
Simulated and measured pulses are of different events, so single pulses cannot be compared.
Their means can, once both datasets are divided at the same quantiles of rise time. Pulses of
one slice then originate from the same regions of the detector.

`gauss_exp` is the kernel of LEGEND's production: sigma and tau are fitted to the
superpulses. `fit_superpulse` divides their spectra. In each slice the mean measured current is
the mean simulated one convolved with the kernel. The transfer function of the kernel is
therefore the ratio of their spectra, H = sum(D S*) / sum(|S|^2) over the slices. A Wiener
factor suppresses H where the measured spectrum does not exceed its statistical error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.optimize
import scipy.signal

from cpunet.electronics.baseline_methods import LONGEST_NS, Kernel, currents, fit_rc, fitted
from cpunet.electronics.chain import ComplexArray as Spectrum
from cpunet.electronics.chain import FloatArray as Values
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import crossings

SLICES = 8
SINGLE_SITE = 0.35  # fraction of the pulses of a slice that is used
RISE_START, RISE_END = 0.02, 0.95  # above the noise at the start, below the slow top
FITTED_ROUNDS = 3  # of the fit of parameters, each with slices from the response fitted so far
EDGE_NS = 1536.0  # time compared before and after the half maximum
FREE_ROUNDS = 4  # of the free kernel, each with half maxima of the response so far
# The kernel before and after the half maximum, and where its ends are tapered.
LEAD_NS, LAG_NS = 512.0, 4096.0
FADE_IN_NS, FADE_OUT_NS = 128.0, 1024.0


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


def with_spectra(windows: FloatArray, dt_ns: float) -> tuple[Values, Spectrum]:
    """Currents of windows and their spectra, see `currents`."""
    current = currents(windows, dt_ns)
    return current, np.asarray(scipy.fft.rfft(current, axis=1))


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
    (measured, of_data), (current, of_sim) = (
        with_spectra(side, dt_ns) for side in (steps, sim)
    )
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

    wanted = mean_currents([of_data[rows] for rows in slices(measured)])
    for _ in range(FITTED_ROUNDS):
        response = scipy.fft.irfft(of_sim * transfer(s, *best), length, axis=1)
        sliced = [of_sim[rows] for rows in slices(response)]
        best = scipy.optimize.least_squares(
            residual, best, bounds=(0.0, high), x_scale=scale, diff_step=1e-3, xtol=1e-4
        ).x
    return transfer(s, *best), dict(zip(parameters, best.tolist(), strict=True))


def fit_superpulse(sim: FloatArray, steps: FloatArray, dt_ns: float) -> Kernel:
    r"""A free kernel: `LEAD_NS` before zero delay and `LAG_NS` from it on, with a sum of 1.

    .. math:: H = W \frac{\sum D S^*}{\sum (|S|^2 + \sigma_S^2)}, \qquad
        W = \max\left(0, 1 - \frac{\sum \sigma_D^2}{\sum |D|^2}\right)

    The sums run over the slices. :math:`D` and :math:`S` are the mean spectra of data and
    simulation, :math:`\sigma_D` and :math:`\sigma_S` their statistical errors. For the
    parameters see `fitted`.
    """
    (current, of_data), (_, spectra) = (with_spectra(side, dt_ns) for side in (steps, sim))
    length = current.shape[1]

    def mean_spectra(spectra: Spectrum, response: Values) -> tuple[Spectrum, Values]:
        """Mean spectrum of each slice, and its squared standard error.

        The error includes noise and the differences between pulses within a slice.
        """
        moved = [aligned(spectra[rows], response[rows]) for rows in slices(response)]
        error = np.array([part.var(axis=0) / max(1, len(part) - 1) for part in moved])
        return np.array([part.mean(axis=0) for part in moved]), error

    measured, data_error = mean_spectra(of_data, current)
    wiener = np.clip(1 - data_error.sum(axis=0) / (np.abs(measured) ** 2).sum(axis=0), 0, 1)
    lead, lag, fade_in, fade_out = (
        round(time / dt_ns) for time in (LEAD_NS, LAG_NS, FADE_IN_NS, FADE_OUT_NS)
    )
    phase = 0.5 * np.pi * (np.arange(lead + lag) + 0.5)
    phase = np.minimum(phase / fade_in, phase[::-1] / fade_out)
    fades = np.sin(phase.clip(max=0.5 * np.pi)) ** 2
    kernel = np.zeros(lead + lag)
    kernel[lead] = 1.0

    def transfer() -> Spectrum:
        """Transfer function of the kernel, which begins `lead` samples before zero delay."""
        around_zero = np.pad(kernel, (0, length - len(kernel)))
        return np.asarray(scipy.fft.rfft(np.roll(around_zero, -lead)))

    for _ in range(FREE_ROUNDS):
        # The simulated pulses are placed by the half maximum of their response. A shift
        # of their own half maximum does not give this exactly.
        response = scipy.fft.irfft(spectra * transfer(), length, axis=1)
        simulated, sim_error = mean_spectra(spectra, response)
        below = (np.abs(simulated) ** 2 + sim_error).sum(axis=0)
        ratio = wiener * (measured * simulated.conj()).sum(axis=0) / below
        kernel = np.roll(scipy.fft.irfft(ratio, length), lead)[: lead + lag] * fades
        kernel /= kernel.sum()
    time_ns = np.arange(len(kernel)) * dt_ns
    mean_ns = float(kernel @ time_ns)
    rms_ns = float(np.sqrt((kernel @ (time_ns - mean_ns) ** 2).clip(min=0.0)))
    return transfer(), {"kernel_mean_ns": mean_ns - LEAD_NS, "kernel_rms_ns": rms_ns}


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
