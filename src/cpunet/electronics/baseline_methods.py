"""Baseline methods a user would choose instead of a network, fitted to the same datasets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol, Self

import numpy as np
import scipy.optimize
import scipy.signal

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_tails import TraceNoise
from cpunet.electronics.finishing import (
    PADDING_AFTER,
    PADDING_BEFORE,
    blocks,
    finish,
    record_length,
)
from cpunet.electronics.fitted_kernels import GaussExp, SuperpulseKernel
from cpunet.electronics.window_response import (
    Values,
    currents,
    fitted_tail_slope,
    integrated,
    require_enough,
    without_decay,
)
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import current_amplitude
from cpunet.recipes.schema import PreparationConfig


class BaselineMethod(Protocol):
    """A baseline method: a causal linear response fitted to unpaired pulses."""

    name: ClassVar[str]

    @property
    def dt_ns(self) -> float:
        """Sampling period in ns of the pulses in the fit."""

    @classmethod
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

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Noise-free response to simulated windows.

        Returns
        -------
        numpy.ndarray
            Records with padding on both sides of the window (see `response`), neither
            aligned nor normalised. `finishing.finish` converts them into windows.
        """

    def describe(self) -> Mapping[str, float]:
        """Fitted values by name. Each name ends with the unit."""


@dataclass(frozen=True)
class Raw:
    """No electronics: the window with padding."""

    dt_ns: float
    name: ClassVar[str] = "raw"

    @classmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Fit nothing, see `BaselineMethod.fit`."""
        require_enough(sim, data)
        return cls(dt_ns)

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Pad the windows to records, see `BaselineMethod.translate`."""
        before = np.zeros((len(waveforms), PADDING_BEFORE), np.float32)
        after = np.repeat(waveforms[:, -1:], PADDING_AFTER, axis=1)
        return np.concatenate([before, waveforms, after], axis=1, dtype=np.float32)

    def describe(self) -> Mapping[str, float]:
        """Nothing was fitted."""
        return {}


LONGEST = 64  # maximum tau, in samples
MAX_PULSES = 4000  # maximum number of pulses in the fit
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
        require_enough(sim, data)
        slope = fitted_tail_slope(data, dt_ns, align)
        steps = without_decay(data[:MAX_PULSES], slope, dt_ns, align).astype(np.float32)
        wanted = most_frequent(current_amplitude(steps))
        window = slice(PADDING_BEFORE, PADDING_BEFORE + sim.shape[1])
        current = currents(sim[:MAX_PULSES])

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


def translate_like_data(
    method: BaselineMethod,
    pulses: Pulses,
    config: PreparationConfig,
    *,
    noise: BaselineNoise | TraceNoise | None = None,
    seed: int | np.random.Generator = 0,
) -> Pulses:
    """Translate prepared simulated pulses and prepare them like the data.

    Parameters
    ----------
    method
        A fitted baseline method.
    pulses
        Prepared simulated pulses.
    config
        Preparation settings of the run.
    noise, seed
        As for `finish`, with the energies of the pulses.

    Returns
    -------
    Pulses
        The same events. A row is NaN if the pulse cannot be prepared.

    Raises
    ------
    CpunetError
        If the sampling period differs from that of the fit, or for the reasons of `finish`.
    """
    if not np.isclose(pulses.dt_ns, method.dt_ns):
        raise CpunetError(
            f"the pulses are sampled every {pulses.dt_ns:g} ns, {method.name} was fitted to "
            f"{method.dt_ns:g} ns; resample the pulses"
        )
    rng = np.random.default_rng(seed)
    windows = np.empty((len(pulses), config.length), np.float32)
    for rows in blocks(len(pulses)):
        part = pulses[rows]
        windows[rows] = finish(
            method.translate(part.waveforms),
            config,
            dt_ns=pulses.dt_ns,
            noise=noise,
            energy_kev=part.energy_kev,
            seed=rng,
        ).windows
    return pulses.with_waveforms(windows)


BASELINE_METHODS: dict[str, type[BaselineMethod]] = {
    method.name: method for method in (Raw, RC, GaussExp, SuperpulseKernel)
}
