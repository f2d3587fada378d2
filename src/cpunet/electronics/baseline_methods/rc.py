"""One RC integration and a decay: the option of the pulse simulation program siggen.

siggen (D. C. Radford) passes its output through s_j = s_{j-1} + (x_{j-1} - s_{j-1}) dt/tau.
Users match tau to the current amplitude of single-site events (100 ns in Bhimani et al.
2026, section 4.1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import scipy.optimize
import scipy.signal

from cpunet.electronics.baseline_methods.base import Values, check_sets, check_windows
from cpunet.electronics.baseline_methods.superpulses import fitted_tail_slope, without_decay
from cpunet.electronics.baseline_methods.window_response import (
    currents,
    integrated,
)
from cpunet.electronics.extension import PADDING_BEFORE, record_length
from cpunet.electronics.finishing import blocks
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import current_amplitude

LONGEST = 64  # maximum tau, in samples
MOST = 4000  # maximum number of pulses in the fit
TOLERANCE = 1e-3  # precision of tau, in samples


@dataclass(frozen=True)
class RC:
    r"""A single RC integration followed by an exponential decay.

    .. math:: s_j = s_{j-1} + (x_{j-1} - s_{j-1})\, \Delta t / \tau

    Parameters
    ----------
    dt_ns
        Sampling period in ns.
    tau_ns
        Time constant of the integration in ns, at least one sampling period.
    tail_slope_per_ms
        Logarithmic slope of the tail in 1/ms.
    """

    dt_ns: float
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
        check_sets(sim, data, dt_ns, align)
        slope = fitted_tail_slope(data, dt_ns, align)
        steps = without_decay(data[:MOST], slope, dt_ns, align).astype(np.float32)
        wanted = most_frequent(current_amplitude(steps))
        window = slice(PADDING_BEFORE, PADDING_BEFORE + sim.shape[1])
        current = currents(sim[:MOST])

        def excess(tau: float) -> float:
            response = np.cumsum(_integration(current, 1 / tau), axis=1)[:, window]
            return most_frequent(current_amplitude(response.astype(np.float32))) - wanted

        if excess(1.0) <= 0:
            # The data rise faster than the simulation: any integration makes it worse.
            return cls(dt_ns, dt_ns, slope)
        if excess(LONGEST) > 0:
            raise CpunetError(
                f"the measured pulses rise slower than an RC of {LONGEST * dt_ns:g} ns makes "
                "them; check the sampling period and the pulses of both sides"
            )
        tau = float(scipy.optimize.brentq(excess, 1.0, LONGEST, xtol=TOLERANCE))
        return cls(dt_ns, tau * dt_ns, slope)

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Apply the integration and the decay, see `BaselineMethod.translate`."""
        check_windows(waveforms, "simulated")
        records = np.empty((len(waveforms), record_length(waveforms.shape[1])), np.float32)
        for rows in blocks(len(waveforms)):
            current = _integration(currents(waveforms[rows]), self.dt_ns / self.tau_ns)
            records[rows] = integrated(current, self.tail_slope_per_ms, self.dt_ns)
        return records

    def describe(self) -> Mapping[str, float]:
        """Time constant and tail slope."""
        return {"tau_ns": self.tau_ns, "tail_slope_per_ms": self.tail_slope_per_ms}


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
