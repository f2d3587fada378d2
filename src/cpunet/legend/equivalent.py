"""Approximation of a readout chain by Gaussian ⊗ exponential, as in production simulations.

As there, sigma and tau are fitted to the averaged current around its maximum, weighted by its
square. The deviations from the chain are reported with them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.optimize
from scipy.special import log_ndtr, ndtr

from cpunet.electronics.exponentials import Exponentials

Values = npt.NDArray[np.float64]

WINDOW, WINDOWS = 48, 3  # width in ns and number of the moving averages of a current
AROUND_NS = 500  # compared range on either side of the maximum
START_NS = (40.0, 60.0)  # initial sigma and tau
LONGEST_NS = 500.0
LENGTH, BEGIN = 8192, 1500  # number of 1 ns samples, and the one at which charge moves
BATCH = 100
WIDTHS_NS = (1, 20, 50, 100, 150, 200, 300)  # of constant currents, as in a detector


@dataclass(frozen=True)
class Equivalent:
    """The Gaussian and exponential kernel nearest to a chain.

    Attributes
    ----------
    sigma_ns, tau_ns
        Standard deviation of the Gaussian and time constant of the exponential.
    prompt_share
        Factor by which the kernel's current fits the chain's: the fraction of the charge in
        the peak.
    current_error_percent
        Largest difference between the averaged currents within 500 ns of the maximum, relative
        to its height.
    late_charge_percent
        Charge that arrives more than 500 ns after the maximum, minus that of the kernel.
    ae_error_percent
        Half the range of the ratio of A/E of kernel and chain, over constant currents that last
        from 1 to 300 ns, divided by its median.
    """

    sigma_ns: float
    tau_ns: float
    prompt_share: float
    current_error_percent: float
    late_charge_percent: float
    ae_error_percent: float


def equivalent_kernel(undecayed: Exponentials) -> Equivalent:
    """Fit sigma and tau to a chain.

    Parameters
    ----------
    undecayed
        The chain without its decays, like data after pole-zero correction.

    Examples
    --------
    >>> two = Exponentials.low_pass(60.0) * Exponentials.low_pass(30.0)
    >>> found = equivalent_kernel(two)
    >>> 10 < found.sigma_ns < 30, 60 < found.tau_ns < 90
    (True, True)
    """
    time = np.arange(LENGTH, dtype=float) - BEGIN
    step = undecayed.step(time)
    wanted = _about_peak(_averaged(step))

    def scaled(parameters: Values) -> tuple[Values, float]:
        found = _about_peak(_averaged(kernel_step(time, *parameters)))
        weight = wanted**2
        return found, float((weight * found * wanted).sum() / (weight * found**2).sum())

    def residual(parameters: Values) -> Values:
        found, height = scaled(parameters)
        return np.asarray(wanted * (height * found - wanted) / wanted.max() ** 2)

    sigma, tau = scipy.optimize.least_squares(
        residual, START_NS, bounds=(0.5, LONGEST_NS), diff_step=1e-4
    ).x
    found, height = scaled(np.array([sigma, tau]))
    peak = BEGIN + int(_averaged(step)[BEGIN:].argmax()) - (WINDOW - 1) * WINDOWS // 2
    kernel = kernel_step(time, sigma, tau)
    # A of the kernel over A of the chain for constant currents
    ratios = np.array(
        [_averaged(kernel, w).max() / _averaged(step, w).max() for w in WIDTHS_NS]
    )
    return Equivalent(
        sigma_ns=float(sigma),
        tau_ns=float(tau),
        prompt_share=height,
        current_error_percent=float(100 * np.abs(height * found - wanted).max() / wanted.max()),
        late_charge_percent=float(
            100 * ((1 - step[peak + AROUND_NS]) - (1 - kernel[peak + AROUND_NS]))
        ),
        ae_error_percent=float(50 * (ratios.max() - ratios.min()) / np.median(ratios)),
    )


def ae_ratios(
    charge: npt.NDArray[np.floating], undecayed: Exponentials, nearest: Equivalent
) -> Values:
    """Ratio of A/E after the kernel to A/E after the chain, for ideal pulses.

    Parameters
    ----------
    charge
        Ideal pulses sampled every nanosecond, shape (n, samples).
    undecayed, nearest
        The chain without decays, and its kernel.
    """
    time = np.arange(LENGTH, dtype=float) - BEGIN
    steps = (undecayed.step(time), kernel_step(time, nearest.sigma_ns, nearest.tau_ns))
    length = scipy.fft.next_fast_len(LENGTH + charge.shape[1], real=True)
    of_steps = [scipy.fft.rfft(_averaged(step), length) for step in steps]
    highest = np.empty((2, len(charge)))
    for first in range(0, len(charge), BATCH):
        rows = slice(first, first + BATCH)
        current = np.diff(charge[rows].astype(float), axis=1, prepend=0)
        spectra = scipy.fft.rfft(current, length, axis=1)
        for which, of_step in enumerate(of_steps):
            highest[which, rows] = scipy.fft.irfft(spectra * of_step, length).max(axis=1)
    return np.asarray(highest[1] / highest[0], np.float64)


def current_delay_ns(undecayed: Exponentials) -> float:
    """Time of the maximum of the averaged current for charge that arrives instantaneously.

    The three averages look back over 48 ns each. Half of their total length is subtracted, so
    that they add no delay.
    """
    current = _averaged(undecayed.step(np.arange(LENGTH, dtype=float) - BEGIN))
    return float(current.argmax() - BEGIN - 0.5 * WINDOWS * (WINDOW - 1))


def kernel_step(time_ns: Values, sigma_ns: float, tau_ns: float) -> Values:
    """Response of Gaussian ⊗ exponential to a step of charge at time 0."""
    scaled = time_ns / sigma_ns
    shift = sigma_ns / tau_ns
    late = np.exp(np.minimum(0.5 * shift**2 - time_ns / tau_ns + log_ndtr(scaled - shift), 0))
    return np.asarray(ndtr(scaled) - late, np.float64)


def _averaged(step: Values, width: int = 1) -> Values:
    """Current of charge arriving evenly over `width` ns, averaged three times over 48 ns."""
    current = np.diff(step, prepend=0.0)
    for size in (width, *(WINDOW,) * WINDOWS):
        total = np.cumsum(current)
        current = (total - np.pad(total, (size, 0))[: len(total)]) / size
    return current


def _about_peak(current: Values) -> Values:
    """Current around its maximum, whose position is interpolated between samples."""
    peak = int(current.argmax())
    low, mid, high = current[peak - 1 : peak + 2]
    time = peak + 0.5 * (low - high) / (low - 2 * mid + high)
    at = time + np.arange(-AROUND_NS, AROUND_NS + 1)
    return np.asarray(np.interp(at, np.arange(len(current)), current), np.float64)
