"""Gaussian and exponential kernel fitted to superpulses: the method of LEGEND's production.

The step response is the convolution of a Gaussian (sigma) with an exponential (tau), followed
by a decay. Sigma and tau are fitted to mean current pulses in slices of rise time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import scipy.fft
import scipy.optimize

from cpunet.electronics.baseline_methods.base import Values, check_sets, check_windows
from cpunet.electronics.baseline_methods.superpulses import (
    Groups,
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
from cpunet.electronics.extension import record_length
from cpunet.pulses.container import FloatArray

MOST = 2000  # maximum number of pulses of either dataset in the fit
ROUNDS = 3  # iterations of the fit, each with slices from the response fitted so far
EDGE = 96  # samples compared before and after the half maximum
START = 2.0  # initial sigma and tau, in samples
LONGEST = 64.0  # maximum sigma and tau, in samples


@dataclass(frozen=True)
class GaussExp:
    r"""A Gaussian and an exponential kernel followed by an exponential decay.

    .. math:: H(\omega) = \frac{e^{-\sigma^2 \omega^2 / 2}}{1 + i \omega \tau}

    Parameters
    ----------
    dt_ns
        Sampling period in ns.
    sigma_ns, tau_ns
        Standard deviation of the Gaussian and time constant of the exponential, in ns.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    """

    dt_ns: float
    sigma_ns: float
    tau_ns: float
    tail_slope_per_ms: float
    name: ClassVar[str] = "gauss_exp"

    @classmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Fit superpulses in slices of rise time, see `BaselineMethod.fit`."""
        check_sets(sim, data, dt_ns, align)
        slope = fitted_tail_slope(data, dt_ns, align)
        steps = without_decay(data[:MOST], slope, dt_ns, align).astype(np.float32)
        measured = currents(steps)
        length = record_length(sim.shape[1])
        of_data = np.asarray(scipy.fft.rfft(measured, axis=1), complex)
        wanted = _mean_currents(of_data, slices(measured), length)
        spectra = np.asarray(scipy.fft.rfft(currents(sim[:MOST]), axis=1), complex)

        best = np.array([START, START])
        for _ in range(ROUNDS):
            transfer = _transfer(length, 1.0, best[0], best[1])
            groups = slices(scipy.fft.irfft(spectra * transfer, length, axis=1))
            # pulses outside the slices do not enter the fit
            sliced = spectra[np.concatenate(groups)]
            ends = np.cumsum([len(group) for group in groups])
            places = np.split(np.arange(ends[-1]), ends[:-1])

            def residual(
                parameters: Values, sliced: Spectrum = sliced, places: Groups = places
            ) -> Values:
                response = sliced * _transfer(length, 1.0, parameters[0], parameters[1])
                return (_mean_currents(response, places, length) - wanted).ravel()

            best = scipy.optimize.least_squares(
                residual, best, bounds=(0.0, LONGEST), diff_step=1e-3, xtol=1e-4
            ).x
        sigma, tau = (best * dt_ns).tolist()
        return cls(dt_ns, sigma, tau, slope)

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Apply the kernel and the decay, see `BaselineMethod.translate`."""
        check_windows(waveforms, "simulated")
        length = record_length(waveforms.shape[1])
        transfer = _transfer(length, self.dt_ns, self.sigma_ns, self.tau_ns)
        return respond(waveforms, transfer, self.tail_slope_per_ms, self.dt_ns)

    def describe(self) -> Mapping[str, float]:
        """Widths of the kernel, and tail slope."""
        return {
            "sigma_ns": self.sigma_ns,
            "tau_ns": self.tau_ns,
            "tail_slope_per_ms": self.tail_slope_per_ms,
        }


def _transfer(length: int, dt_ns: float, sigma_ns: float, tau_ns: float) -> Spectrum:
    """Fourier transform of the kernel at the frequencies of a record."""
    omega = 2e-3 * np.pi * scipy.fft.rfftfreq(length, 1e-3 * dt_ns)  # 1/ns
    gauss = np.exp(-0.5 * (omega * sigma_ns) ** 2)
    return np.asarray(gauss / (1 + 1j * omega * tau_ns), complex)


def _mean_currents(spectra: Spectrum, groups: Groups, length: int) -> Values:
    """Superpulses of currents around the half maximum, shape ``(slices, 2 * EDGE)``."""
    steps = np.cumsum(scipy.fft.irfft(spectra, length, axis=1), axis=1)
    means = superpulses(spectra, crossing(steps, 0.5), groups, length)
    return np.asarray(
        np.roll(scipy.fft.irfft(means.spectra, length, axis=1), EDGE, axis=1)[:, : 2 * EDGE],
        float,
    )
