"""A free kernel from superpulses: the Wiener-regularised ratio of mean spectra.

In each slice of rise time the mean measured current is the mean simulated current convolved
with the kernel. The transfer function of the kernel is therefore the ratio of their spectra,
H = sum(D S*) / sum(|S|^2) over the slices. A Wiener factor suppresses H where the measured
spectrum does not exceed its statistical error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
import scipy.fft

from cpunet.electronics.baseline_methods.base import Values, check_sets, check_windows
from cpunet.electronics.baseline_methods.superpulses import (
    Superpulses,
    crossing,
    fitted_tail_slope,
    slices,
    superpulses,
    without_decay,
)
from cpunet.electronics.baseline_methods.window_response import (
    Spectrum,
    currents,
    respond,
)
from cpunet.electronics.extension import PADDING_BEFORE, record_length
from cpunet.pulses.container import FloatArray

MOST = 4000  # maximum number of pulses of either dataset
ROUNDS = 4  # iterations of the kernel, each with half maxima of the response found so far
LEAD, LAG = 32, 256  # samples of the kernel before and after the half maximum
FADE_IN, FADE_OUT = 8, 64  # samples over which the ends of the kernel are tapered


@dataclass(frozen=True, eq=False)
class Superpulse:
    r"""A free kernel followed by an exponential decay.

    .. math:: H = W \frac{\sum D S^*}{\sum (|S|^2 + \sigma_S^2)}, \qquad
        W = \max\left(0, 1 - \frac{\sum \sigma_D^2}{\sum |D|^2}\right)

    The sums run over the slices. :math:`D` and :math:`S` are the mean spectra of data and
    simulation, :math:`\sigma_D` and :math:`\sigma_S` their statistical errors.

    Parameters
    ----------
    dt_ns
        Sampling period in ns.
    kernel
        Weights with a sum of 1: `LEAD` samples before zero delay and `LAG` from it on.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    """

    dt_ns: float
    kernel: Values
    tail_slope_per_ms: float
    name: ClassVar[str] = "superpulse"

    @classmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Divide the mean spectra, see `BaselineMethod.fit`."""
        check_sets(sim, data, dt_ns, align)
        slope = fitted_tail_slope(data, dt_ns, align)
        steps = without_decay(data[:MOST], slope, dt_ns, align).astype(np.float32)
        length = record_length(sim.shape[1])
        current = currents(steps)
        wanted = _superpulses(np.asarray(scipy.fft.rfft(current, axis=1)), current)

        spectra = np.asarray(scipy.fft.rfft(currents(sim[:MOST]), axis=1))
        kernel = np.zeros(LEAD + LAG)
        kernel[LEAD] = 1.0
        for _ in range(ROUNDS):
            # The simulated pulses are placed by the half maximum of their response. A shift
            # of their own half maximum does not give this exactly.
            response = scipy.fft.irfft(spectra * _transfer(kernel, length), length, axis=1)
            kernel = _kernel(wanted, _superpulses(spectra, response), length)
        found = cls(dt_ns, kernel, slope)
        # subtract the contribution of the kernel's late part to the tail slope from the decay
        windows = found.translate(sim[:MOST])[:, PADDING_BEFORE : PADDING_BEFORE + sim.shape[1]]
        excess = fitted_tail_slope(windows, dt_ns, align) - slope
        return replace(found, tail_slope_per_ms=slope - excess)

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Apply the kernel and the decay, see `BaselineMethod.translate`."""
        check_windows(waveforms, "simulated")
        transfer = _transfer(self.kernel, record_length(waveforms.shape[1]))
        return respond(waveforms, transfer, self.tail_slope_per_ms, self.dt_ns)

    def describe(self) -> Mapping[str, float]:
        """Mean and standard deviation of the kernel, and tail slope."""
        time = np.arange(len(self.kernel)) * self.dt_ns
        mean = float(self.kernel @ time)
        variance = float(self.kernel @ (time - mean) ** 2)
        return {
            "kernel_mean_ns": mean - LEAD * self.dt_ns,
            "kernel_rms_ns": float(np.sqrt(max(variance, 0.0))),
            "tail_slope_per_ms": self.tail_slope_per_ms,
        }


def _superpulses(spectra: Spectrum, response: Values) -> Superpulses:
    """Superpulses of currents, aligned and sliced by their responses."""
    steps = np.cumsum(response, axis=1)
    half_times = crossing(steps, 0.5)
    return superpulses(spectra, half_times, slices(response), response.shape[1])


def _kernel(data: Superpulses, sim: Superpulses, length: int) -> Values:
    """Regularised ratio as weights around zero delay with a sum of 1."""
    power = (np.abs(data.spectra) ** 2).sum(axis=0)
    wiener = np.clip(1 - data.error.sum(axis=0) / power, 0, 1)
    below = (np.abs(sim.spectra) ** 2 + sim.error).sum(axis=0)
    ratio = wiener * (data.spectra * sim.spectra.conj()).sum(axis=0) / below
    weights = np.roll(scipy.fft.irfft(ratio, length), LEAD)[: LEAD + LAG]
    weights[:FADE_IN] *= _fade(FADE_IN)
    weights[-FADE_OUT:] *= _fade(FADE_OUT)[::-1]
    return np.asarray(weights / weights.sum(), float)


def _fade(samples: int) -> Values:
    return np.asarray(np.sin(0.5 * np.pi * (np.arange(samples) + 0.5) / samples) ** 2, float)


def _transfer(kernel: Values, length: int) -> Spectrum:
    around_zero = np.zeros(length)
    around_zero[: len(kernel)] = kernel
    return np.asarray(scipy.fft.rfft(np.roll(around_zero, -LEAD)), complex)
