"""The response of a readout chain: a few physical parameters, and what deviates from these.

Charge becomes signal through bandwidth poles, slow components (or overshoot, if negative), and
decays.  All act on the current of a pulse in the frequency domain, so that a set of pulses
costs two Fourier transforms.  Before it, the drift of the simulated pulses may be stretched in
time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.interpolate import CubicSpline

from cpunet.electronics.finishing import padding as padding
from cpunet.electronics.finishing import record_length as record_length
from cpunet.networks import Stored
from cpunet.networks.by_height import ByHeight
from cpunet.recipes.schema import ResponseConfig

Values = npt.NDArray[np.float64]
Floats = npt.NDArray[np.floating[Any]]
Spectrum = npt.NDArray[np.complexfloating[Any, Any]]

# Fractions of the final charge at which collection begins and ends.
BEGIN, END = 1e-6, 0.999
LONGEST_US = 3.0  # time before the end from which the factor is constant
MIN_STRETCH = 0.2
ROUNDS = 20  # in which a duration converges
STRETCHES = "drift_stretch", "drift_stretch_per_us"  # names of its terms


class DriftClock(Stored):
    r"""Stretches the drift of simulated pulses; nothing changes at the start.

    If the simulated charges drift faster or slower than those of the detector (temperature,
    impurities, mobilities), no readout chain can make the two sides agree.  The paths are
    nearly the same, only their times are not: what arrives :math:`t` before the end of the
    collection in the detector arrives :math:`u` before it in the simulation,

    .. math:: \frac{t}{u} = 1 + a + b\,t .

    With :math:`b`, the last part of the path, near the contact, may be stretched by another
    factor than earlier ones.  This is not part of the readout, and does not tell which physics
    are off; for that, see `cpunet.calibration`.

    Parameters
    ----------
    terms
        1 for :math:`a` alone, 2 for :math:`a` and :math:`b` per microsecond.

    Examples
    --------
    A charge that rises over 40 samples rises over 44 if drift takes a tenth longer:

    >>> clock = DriftClock(1)
    >>> clock.stretch[:] = 0.1
    >>> ramp = np.clip(np.arange(-60, 20) / 40 + 1, 0, 1)[np.newaxis]
    >>> int((ramp > 0.5).sum()), int((clock(ramp, dt_ns=16.0) > 0.5).sum())
    (39, 41)
    """

    keeps_begin = False
    """Whether a pulse stays where its charge begins to move, not where its collection ends."""

    def __init__(self, terms: int) -> None:
        self.stretch = np.zeros(terms)

    def __call__(self, windows: Floats, *, dt_ns: float) -> Floats:
        """Stretch pulses in time about the end of their collection.

        Parameters
        ----------
        windows
            Charge of any height, 0 before it moves, shape (batch, samples).
        dt_ns
            Sampling period in ns.

        Returns
        -------
        array
            Of the same shape, type and height.
        """
        highest, last = windows.max(axis=1, keepdims=True), windows.shape[1] - 1
        end = (windows >= END * highest).argmax(axis=1, keepdims=True)
        later: Values = np.zeros(end.shape)
        if self.keeps_begin:
            begin = (windows > BEGIN * highest).argmax(axis=1, keepdims=True)
            took = longer = (end - begin + 1).astype(float)
            for _ in range(ROUNDS):  # of t = u (1 + a + b t)
                longer = took * self._factor(longer, 1e-3 * dt_ns)
            later = longer - took
        before = end + later - np.arange(last + 1)
        source = end - before / self._factor(before, 1e-3 * dt_ns)
        # values at these times by cubics (Catmull-Rom); ends are held
        lower = np.floor(source).clip(0, last)
        part = (source - lower).clip(0, 1).astype(windows.dtype)
        a, b, c, d = (
            np.take_along_axis(windows, (lower.astype(np.intp) + i).clip(0, last), axis=1)
            for i in (-1, 0, 1, 2)
        )
        rise, bend = 0.5 * (c - a), a - 2.5 * b + 2 * c - 0.5 * d
        skew = 0.5 * (d - a) + 1.5 * (b - c)
        return np.asarray(b + part * (rise + part * (bend + part * skew)))

    def _factor(self, before: Values, dt_us: float) -> Values:
        """Factor of the time of each sample before the end."""
        us = (dt_us * before).clip(0.0, LONGEST_US)
        factor = 1 + sum(term * us**i for i, term in enumerate(self.stretch))
        return np.maximum(factor, MIN_STRETCH)


# Charge is zero before a window and constant after it, but decays outlast the record: their
# kernel is cut, and the transform is long enough to avoid wrap-around.
MIN_FACTOR = 1.6
STEP_NS = 12_800.0  # of the response to a step whose half rise is the delay
DEVIATION_NS = -100.0, 8400.0  # in which a step response deviates from its chain
LATE_NS, MIN_LEFT = (4000.0, 6400.0), 0.01  # whose decay goes on later, and least part left
DRAWS = 64  # of deviations within their errors
SHARPNESS = 0.5  # to begin with, between means over a period (0) and points (1)
IMAGES = 3  # images of the spectrum on either side


def deviation_lags(dt_ns: float) -> npt.NDArray[np.intp]:
    """Samples from a step at which its response deviates from the chain."""
    first, stop = (round(ns / dt_ns) for ns in DEVIATION_NS)
    return np.arange(first, stop)


class ElectronicsResponse(Stored):
    r"""Charge pulses → noise-free records of any height, by physical parameters.

    With bandwidth poles :math:`\tau_k`, weights :math:`w_j` of slow parts of fixed times
    :math:`T_j`, and shares :math:`a_i` of decays :math:`\tau_i` faster than the main decay,

    .. math:: H(s) = \prod_k \frac{1}{1 + s \tau_k}
        \left[1 - \sum_j w_j + \sum_j \frac{w_j}{1 + s T_j}\right], \qquad
        d(t) = \left(1 - \sum_i a_i\right) e^{-t/\tau} + \sum_i a_i e^{-t/\tau_i}

    the current of a pulse is multiplied by :math:`H` and by the spectrum of :math:`d`.  Times
    are stored as logarithms, so that they stay positive and steps are relative.  What no such
    chain does is a deviation of the step response at each lag, see
    `cpunet.training.deviations`; later, the step decays as from 4 to 6.4 µs.

    Parameters
    ----------
    config
        Number of poles, the times whose weights are free, and initial values.
    dt_ns
        Sampling period of the pulses in ns.

    References
    ----------
    V. Radeka, Ann. Rev. Nucl. Part. Sci. 38 (1988) 217 (charge-sensitive readout).

    Examples
    --------
    At :math:`s = i/\tau` a pole passes :math:`1/(1 + i)`, and 100 samples of 16 ns later a
    decay of 100 µs has left :math:`e^{-1.6/100}`:

    >>> from cpunet.recipes import load_recipe
    >>> config = load_recipe("fast").generator.model_copy(
    ...     update={"poles_ns": (64.0,), "decay_us": 100.0})
    >>> response = ElectronicsResponse(config, dt_ns=16)
    >>> complex(response.bandwidth(np.array([1j / 64]))[0].round(6))
    (0.5-0.5j)
    >>> step = (np.arange(800) >= 400)[np.newaxis].astype(np.float32)
    >>> record = response(step)[0, padding(16)[0] + 400 :]
    >>> round(float(record[200] / record[100]), 5), round(math.exp(-1.6 / 100), 5)
    (0.98413, 0.98413)
    """

    def __init__(self, config: ResponseConfig, dt_ns: float) -> None:
        self.config, self.dt_ns = config, np.array(float(dt_ns))
        self.log_poles_ns = np.log(config.poles_ns)
        self.log_decay_us = np.log([config.decay_us])
        self.slow_ns = np.array(config.slow_ns, float)
        self.fast_decays_us = np.array(config.fast_decays_us, float)
        self.slow_weights = np.zeros(len(self.slow_ns))
        self.sharpness = np.array([SHARPNESS])
        self.decay_weights = np.zeros(len(self.fast_decays_us))
        self.drift = DriftClock(config.drift_terms) if config.drift_terms else None
        self.by_height = ByHeight() if config.by_height else None
        if config.deviations:
            lags = len(deviation_lags(dt_ns))
            self.deviation_dt_ns = float(dt_ns)  # the response itself may be sampled otherwise
            # at each lag, and draws whose outer products are its covariance
            self.deviation, self.deviation_draws = np.zeros(lags), np.zeros((DRAWS, lags))

    @property
    def parameters(self) -> dict[str, Values]:
        """What is fitted, by name: the arrays themselves."""
        fixed = {"dt_ns", "slow_ns", "fast_decays_us", "deviation", "deviation_draws"}
        return {
            name: values
            for name, values in self.arrays().items()
            if name not in fixed and not name.startswith("by_height") and len(values)
        }

    def __call__(self, windows: Floats) -> npt.NDArray[np.float32]:
        """Apply the response to prepared simulated pulses.

        Parameters
        ----------
        windows
            Shape (batch, samples), 0 … 1.

        Returns
        -------
        array
            Shape (batch, record_length).
        """
        length = record_length(windows.shape[1], dt_ns := float(self.dt_ns))
        moved, before, padded = self.drifted(windows), padding(dt_ns)[0], padded_length(length)
        current = np.zeros((len(moved), before + moved.shape[1]), moved.dtype)
        current[:, before:] = np.diff(moved, axis=1, prepend=0)
        spectrum: Spectrum = scipy.fft.rfft(current, padded)
        spectrum *= self.transfer(padded).astype(np.complex64)
        signal: npt.NDArray[np.float32] = scipy.fft.irfft(spectrum, padded, overwrite_x=True)
        return signal[:, :length]

    def drifted(self, windows: Floats) -> Floats:
        """Simulated pulses with their drift stretched, as they enter the readout."""
        return windows if self.drift is None else self.drift(windows, dt_ns=float(self.dt_ns))

    def transfer(self, padded: int) -> npt.NDArray[np.complex128]:
        r"""Response to a step of charge at sample 0, as a spectrum of `padded` samples.

        The samples of a pulse are means over the sampling period :math:`T`, and so are those of
        the signal at a sharpness :math:`\kappa` of 0.  At 1 they are points, as a digitiser
        takes them: :math:`1 + \kappa (\omega T)^2 / 24` undoes the mean.  Between samples, the
        collected charge is interpolated by a cubic spline, which causes images of the spectrum
        above half the sampling rate; the part of them that passes the electronics is aliased
        back.
        """
        dt_ns = float(self.dt_ns)
        frequency = np.fft.rfftfreq(padded)
        image = np.arange(-IMAGES, IMAGES + 1.0)[:, np.newaxis]
        everywhere = frequency + image  # (images, frequencies), in units of 1/period
        passed = self.bandwidth(2j * math.pi * everywhere / dt_ns)
        passed = passed * (1 + self.sharpness / 24 * (2 * math.pi * everywhere) ** 2)
        # spectrum of the cardinal cubic spline (Unser, Aldroubi and Eden, IEEE Trans. Signal
        # Process. 41 (1993) 821)
        spline = np.sinc(everywhere) ** 4 * 3 / (2 + np.cos(2 * math.pi * everywhere))
        fast = (spline * passed).sum(axis=0)
        n_after = math.ceil(padded / MIN_FACTOR) - padding(dt_ns)[0]
        # response of the decays alone to a step of 1
        time_us = 1e-3 * dt_ns * np.arange(n_after, dtype=float)
        decays = main = np.exp(-time_us / np.exp(self.log_decay_us))
        for weight, tau in zip(self.decay_weights, self.fast_decays_us, strict=True):
            decays = decays + weight * (np.exp(-time_us / tau) - main)
        whole: npt.NDArray[np.complex128] = fast * scipy.fft.rfft(decays, padded)
        if not self.config.deviations:
            return whole
        lags, deviation = deviation_lags(dt_ns), self.deviation
        if dt_ns != self.deviation_dt_ns:
            time_ns = (deviation_lags(self.deviation_dt_ns) + 0.5) * self.deviation_dt_ns
            deviation = CubicSpline(time_ns, deviation)((lags + 0.5) * dt_ns)
        first, last = int(lags[0]), int(lags[-1])
        step = np.zeros(padded)
        step[first:], step[: last + 1] = deviation[:-first], deviation[-first:]
        if n_after > last + 1:  # the whole goes on as it does before the end of the windows
            base = scipy.fft.irfft(whole, padded)
            early, late = (round(ns / dt_ns) for ns in LATE_NS)
            inside = base[: last + 1] + deviation[-first:]
            rate = math.log(max(inside[late] / inside[early], MIN_LEFT)) / (late - early)
            after = np.exp(rate * np.arange(n_after - last))
            step[last:n_after] = inside[last] * after - base[last:n_after]
        step[n_after : padded + first] = 0
        return np.asarray(whole + scipy.fft.rfft(step))

    def delay_ns(self) -> float:
        """Time in ns at which the response to a step is half as high as its maximum."""
        dt_ns = float(self.dt_ns)
        padded = padded_length(record_length(round(STEP_NS / dt_ns), dt_ns))
        lead = padding(dt_ns)[0]
        step = np.roll(scipy.fft.irfft(self.transfer(padded), padded), lead)[: padded - lead]
        after = int((step >= 0.5 * step.max()).argmax())
        low, high = step[after - 1], step[after]
        place = after - 1 + float((0.5 * step.max() - low) / (high - low))
        # a sample is the mean over its period
        return (place + 0.5 - lead) * dt_ns

    def bandwidth(self, s: Spectrum) -> Spectrum:
        """Transfer function of all but the decays at `s` in 1/ns."""
        transfer = np.ones_like(s)
        for tau in np.exp(self.log_poles_ns):
            transfer = transfer / (1 + s * tau)
        slow = np.ones_like(s)
        for weight, tau in zip(self.slow_weights, self.slow_ns, strict=True):
            slow = slow + weight * (1 / (1 + s * tau) - 1)
        return transfer * slow

    def named(self) -> dict[str, tuple[str, float]]:
        """Fitted parameters by name, with the unit at its end: label and value of each.

        A label is the name of the tensor and the place in it, as ``"slow_weights.1"``.
        """
        poles = enumerate(np.exp(self.log_poles_ns).tolist(), 1)
        falling = enumerate(sorted(poles, key=lambda pole: -pole[1]), 1)
        values = {f"pole_{i}_ns": (f"log_poles_ns.{k}", tau) for i, (k, tau) in falling}
        slow = zip(self.slow_ns.tolist(), self.slow_weights.tolist(), strict=True)
        for i, (tau, weight) in enumerate(slow, 1):
            values[f"slow_{tau:g}_ns"] = f"slow_weights.{i}", weight
        values["decay_us"] = "log_decay_us.1", float(np.exp(self.log_decay_us[0]))
        values["sharpness"] = "sharpness.1", float(self.sharpness[0])
        fast = zip(self.fast_decays_us.tolist(), self.decay_weights.tolist(), strict=True)
        for i, (tau, weight) in enumerate(fast, 1):
            values[f"decay_{tau:g}_us"] = f"decay_weights.{i}", weight
        stretch = [] if self.drift is None else self.drift.stretch.tolist()
        for i, (name, value) in enumerate(zip(STRETCHES, stretch, strict=False), 1):
            values[name] = f"drift.stretch.{i}", value
        return values

    def describe(self) -> dict[str, float]:
        """Fitted parameters by name, with the unit at the end of the name.

        ``deviation`` is the largest of the step response.
        """
        values = {name: value for name, (_, value) in self.named().items()}
        if self.config.deviations:
            values["deviation"] = float(np.abs(self.deviation).max())
        if self.by_height is not None:
            values |= self.by_height.describe(float(self.dt_ns))
        return values


def padded_length(length: int) -> int:
    """Length of the Fourier transform of a record of this length, even, in samples."""
    half = (math.ceil(MIN_FACTOR * length) + 1) // 2
    return 2 * int(scipy.fft.next_fast_len(half, real=True))
