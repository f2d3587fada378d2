"""The response of a readout chain as a differentiable layer: a few physical parameters.

Charge becomes signal through bandwidth poles, slow components (or overshoot, if negative), an
optional ringing, and decays.  All act on the current of a pulse in the frequency domain, so
that a set of pulses costs two Fourier transforms.  Before it, the drift of the simulated pulses
may be stretched in time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.fft
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor, nn

from cpunet.electronics.finishing import padding as padding
from cpunet.electronics.finishing import record_length as record_length
from cpunet.recipes.schema import ResponseConfig

# Fractions of the final charge at which collection begins and ends.
BEGIN, END = 1e-6, 0.999
LONGEST_US = 3.0  # time before the end from which the factor is constant
MIN_STRETCH = 0.2
ROUNDS = 20  # in which a duration converges


class DriftClock(nn.Module):
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
    >>> _ = clock.stretch.data.fill_(0.1)
    >>> ramp = torch.arange(-60, 20).div(40.0).add(1).clamp(0, 1)[None]
    >>> int((ramp > 0.5).sum()), int((clock(ramp, dt_ns=16.0) > 0.5).sum())
    (39, 41)
    """

    keeps_begin = False
    """Whether a pulse stays where its charge begins to move, not where its collection ends."""

    def __init__(self, terms: int) -> None:
        super().__init__()
        self.stretch = nn.Parameter(torch.zeros(terms, dtype=torch.float64))

    def forward(self, windows: Tensor, *, dt_ns: float) -> Tensor:
        """Stretch pulses in time about the end of their collection.

        Parameters
        ----------
        windows
            Charge of any height, 0 before it moves, shape (batch, samples).
        dt_ns
            Sampling period in ns.

        Returns
        -------
        Tensor
            Of the same shape and height.
        """
        highest = windows.amax(dim=1, keepdim=True)
        end = _first(windows >= END * highest)
        later = torch.zeros_like(end)
        if self.keeps_begin:
            took = end - _first(windows > BEGIN * highest) + 1
            later = self._duration(took, 1e-3 * dt_ns) - took
        before = end + later - torch.arange(windows.shape[1], device=windows.device)
        source = end - before / self._factor(before, 1e-3 * dt_ns)
        return at_times(windows, source)

    def _factor(self, before: Tensor, dt_us: float) -> Tensor:
        """Factor of the time of each sample before the end."""
        us = (dt_us * before).clamp(0.0, LONGEST_US)
        powers = torch.stack([us**i for i in range(len(self.stretch))], dim=-1)
        factor: Tensor = 1 + powers.to(self.stretch.dtype) @ self.stretch
        return factor.clamp_min(MIN_STRETCH)

    def _duration(self, took: Tensor, dt_us: float) -> Tensor:
        """Duration of a drift in samples in the detector, given the simulated one."""
        longer = took.to(self.stretch.dtype)
        for _ in range(ROUNDS):  # t = u (1 + a + b t)
            longer = took * self._factor(longer, dt_us)
        return longer

    def describe(self) -> dict[str, float]:
        """Fitted values by name, with the unit at the end of the name."""
        names = ("drift_stretch", "drift_stretch_per_us")
        return dict(zip(names, self.stretch.tolist(), strict=False))


def _first(where: Tensor) -> Tensor:
    """First sample of each row for which a condition holds, shape (batch, 1)."""
    return where.to(torch.uint8).argmax(dim=1, keepdim=True)


def at_times(windows: Tensor, times: Tensor) -> Tensor:
    """Values at times in samples, by cubics (Catmull-Rom); ends are held."""
    last = windows.shape[1] - 1
    first = times.detach().floor().clamp(0.0, float(last))
    part, first = (times - first).clamp(0.0, 1.0).to(windows.dtype), first.long()
    a, b, c, d = (windows.gather(1, (first + i).clamp(0, last)) for i in (-1, 0, 1, 2))
    rise, bend = 0.5 * (c - a), a - 2.5 * b + 2 * c - 0.5 * d
    skew = 0.5 * (d - a) + 1.5 * (b - c)
    between: Tensor = b + part * (rise + part * (bend + part * skew))
    return between


# Charge is zero before a window and constant after it, but decays outlast the record: their
# kernel is cut, and the transform is long enough to avoid wrap-around.
MIN_FACTOR = 1.6
STEP_NS = 12_800.0  # of the response to a step whose half rise is the delay
DEVIATION_NS = -100.0, 8400.0  # in which a step response deviates from its chain
LATE_NS, MIN_LEFT = (4000.0, 6400.0), 0.01  # whose decay goes on later, and least part left
DRAWS = 64  # of deviations within their errors
IMAGES = 3  # images of the spectrum on either side


def late_lags(dt_ns: float) -> tuple[int, int]:
    """Samples from a step between which its decay is that of later, too."""
    early, late = (round(ns / dt_ns) for ns in LATE_NS)
    return early, late


def deviation_lags(dt_ns: float) -> npt.NDArray[np.intp]:
    """Samples from a step at which its response deviates from the chain."""
    first, stop = (round(ns / dt_ns) for ns in DEVIATION_NS)
    return np.arange(first, stop)


class ElectronicsResponse(nn.Module):
    r"""Charge pulses → noise-free records of any height, by physical parameters.

    With bandwidth poles :math:`\tau_k`, weights :math:`w_j` of slow parts of fixed times
    :math:`T_j`, and shares :math:`a_i` of decays :math:`\tau_i` faster than the main one,

    .. math:: H(s) = \prod_k \frac{1}{1 + s \tau_k}
        \left[1 - \sum_j w_j + \sum_j \frac{w_j}{1 + s T_j}\right], \qquad
        d(t) = \left(1 - \sum_i a_i\right) e^{-t/\tau} + \sum_i a_i e^{-t/\tau_i}

    the current of a pulse is multiplied by :math:`H` and by the spectrum of :math:`d`.  Times
    are kept as logarithms, so that they stay positive and steps are relative.  What no such
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
    At :math:`s = i/\tau` one pole passes :math:`1/(1 + i)`, and 100 samples of 16 ns later a
    decay of 100 µs has left :math:`e^{-1.6/100}`:

    >>> from cpunet.recipes import load_recipe
    >>> config = load_recipe("fast").generator.model_copy(
    ...     update={"poles_ns": (64.0,), "decay_us": 100.0})
    >>> response = ElectronicsResponse(config, dt_ns=16)
    >>> complex(response.bandwidth(torch.tensor([1j / 64]))[0].detach())
    (0.5-0.5j)
    >>> step = (torch.arange(800) >= 400).float()[None]
    >>> record = response(step)[0].detach()[padding(16)[0] + 400 :]
    >>> round(float(record[200] / record[100]), 5), round(math.exp(-1.6 / 100), 5)
    (0.98413, 0.98413)
    """

    dt_ns: Tensor
    slow_ns: Tensor
    fast_decays_us: Tensor
    deviation: Tensor
    deviation_draws: Tensor
    drift: DriftClock | None
    decay_known: float | None = None
    """Relative error of the main decay, if it is known from baselines."""

    def __init__(self, config: ResponseConfig, dt_ns: float) -> None:
        super().__init__()
        self.register_buffer("dt_ns", torch.tensor(float(dt_ns), dtype=torch.float64))
        self.config = config

        def log(values: Sequence[float]) -> nn.Parameter:
            return nn.Parameter(torch.tensor(values, dtype=torch.float64).log())

        def weights(values: Sequence[float]) -> nn.Parameter:
            return nn.Parameter(torch.zeros(len(values), dtype=torch.float64))

        self.log_poles_ns = log(config.poles_ns)
        self.log_decay_us = log([config.decay_us])
        self.slow_weights = weights(config.slow_ns)
        self.decay_weights = weights(config.fast_decays_us)
        for name in ("slow_ns", "fast_decays_us"):
            times = torch.tensor(getattr(config, name), dtype=torch.float64)
            self.register_buffer(name, times)
        if config.free_decays:
            self.log_fast_decays_us = log(config.fast_decays_us)
        rings = [] if config.ringing_mhz is None else [config.ringing_mhz, config.ringing_ns]
        # weights of sine and cosine; frequency in MHz and damping in ns
        self.ringing = weights(rings)
        self.log_ringing = log(rings)
        self.drift = DriftClock(config.drift_terms) if config.drift_terms else None
        if config.deviations:
            shape = DRAWS, len(deviation_lags(dt_ns))
            self.deviation_dt_ns = float(dt_ns)  # the response itself may be sampled otherwise
            self.register_buffer("deviation", torch.zeros(shape[1], dtype=torch.float64))
            self.register_buffer("deviation_draws", torch.zeros(shape, dtype=torch.float64))

    def set_deviation(
        self, deviation: npt.NDArray[Any], draws: npt.NDArray[Any] | None = None
    ) -> None:
        """Set the deviation at each lag, and draws whose outer products are its covariance."""
        self.deviation.copy_(torch.from_numpy(deviation))
        if draws is not None:  # (lags, draws)
            self.deviation_draws.copy_(torch.from_numpy(draws.T))

    def forward(self, windows: Tensor) -> Tensor:
        """Apply the response to prepared simulated pulses.

        Parameters
        ----------
        windows
            Shape (batch, samples), 0 … 1.

        Returns
        -------
        Tensor
            Shape (batch, record_length).
        """
        length = record_length(windows.shape[1], dt_ns := float(self.dt_ns))
        padded = padded_length(length)
        windows = self.drifted(windows)
        transfer = self.transfer(padded).to(torch.complex64)
        spectrum = current_spectrum(windows, padded, dt_ns) * transfer
        signal: Tensor = torch.fft.irfft(spectrum, padded)[:, :length]
        return signal

    def drifted(self, windows: Tensor) -> Tensor:
        """Simulated pulses with their drift stretched, as they enter the readout."""
        if self.drift is None:
            return windows
        stretched: Tensor = self.drift(windows, dt_ns=float(self.dt_ns))
        return stretched

    def transfer(self, padded: int) -> Tensor:
        """Response to a step of charge at sample 0, as a spectrum of `padded` samples.

        The samples of a pulse are means over the sampling period, and so are those of the
        signal.  Between samples, the collected charge is interpolated by a cubic spline, which
        causes images of the spectrum above half the sampling rate; the part of them that passes
        the electronics is aliased back.
        """
        dt_ns = self.dt_ns
        frequency = torch.fft.rfftfreq(padded, d=1.0, dtype=torch.float64).to(dt_ns.device)
        image = torch.arange(-IMAGES, IMAGES + 1, device=dt_ns.device)[:, None]
        everywhere = frequency + image  # (images, frequencies), in units of 1/period
        passed = self.bandwidth(2j * math.pi * everywhere / dt_ns)
        fast = (_spline(everywhere) * passed).sum(dim=0)
        kept = math.ceil(padded / MIN_FACTOR) - padding(float(dt_ns))[0]
        time_us = torch.arange(kept, dtype=torch.float64, device=dt_ns.device) * dt_ns * 1e-3
        whole: Tensor = fast * torch.fft.rfft(self.decay(time_us), padded)
        if not self.config.deviations:
            return whole
        lags, deviation = deviation_lags(float(dt_ns)), self.deviation.cpu().numpy()
        if float(dt_ns) != self.deviation_dt_ns:
            time_ns = (deviation_lags(self.deviation_dt_ns) + 0.5) * self.deviation_dt_ns
            deviation = CubicSpline(time_ns, deviation)((lags + 0.5) * float(dt_ns))
        first, last = int(lags[0]), int(lags[-1])
        step = torch.zeros(padded, dtype=torch.float64, device=dt_ns.device)
        values = torch.from_numpy(deviation).to(step)
        step[first:], step[: last + 1] = values[:-first], values[-first:]
        if kept > last + 1:  # the whole goes on as it does before the end of the windows
            base = torch.fft.irfft(whole.detach(), padded)
            (early, late), there = late_lags(float(dt_ns)), base[: last + 1] + values[-first:]
            left = float(there[late] / there[early])
            rate = math.log(max(left, MIN_LEFT)) / (late - early)
            after = torch.arange(kept - last).to(step)
            step[last:kept] = there[last] * torch.exp(rate * after) - base[last:kept]
        step[kept : padded + first] = 0
        with_deviation: Tensor = whole + torch.fft.rfft(step, padded)
        return with_deviation

    @torch.no_grad()
    def delay_ns(self) -> float:
        """Time in ns at which the response to a step is half as high as its maximum."""
        dt_ns = float(self.dt_ns)
        padded = padded_length(record_length(round(STEP_NS / dt_ns), dt_ns))
        lead = padding(dt_ns)[0]
        step = torch.fft.irfft(self.transfer(padded), padded).roll(lead)[: padded - lead]
        after = int((step >= 0.5 * step.max()).int().argmax())
        low, high = step[after - 1], step[after]
        place = after - 1 + float((0.5 * step.max() - low) / (high - low))
        # a sample is the mean over its period
        return (place + 0.5 - lead) * dt_ns

    @property
    def fast_times_us(self) -> Tensor:
        """Times of the faster decays, fixed or free."""
        return self.log_fast_decays_us.exp() if self.config.free_decays else self.fast_decays_us

    def bandwidth(self, s: Tensor) -> Tensor:
        """Transfer function of all but the decays at `s` in 1/ns."""
        transfer = torch.ones_like(s)
        for tau in self.log_poles_ns.exp():
            transfer = transfer / (1 + s * tau)
        slow = torch.ones_like(s)
        for weight, tau in zip(self.slow_weights, self.slow_ns, strict=True):
            slow = slow + weight * (1 / (1 + s * tau) - 1)
        if len(self.ringing):
            frequency_mhz, damping = self.log_ringing.exp()
            omega = 2e-3 * math.pi * frequency_mhz
            damped = s + 1 / damping
            wave = self.ringing[0] * omega + self.ringing[1] * damped
            slow = slow * (1 + s * wave / (damped**2 + omega**2))
        return transfer * slow

    def decay(self, time_us: Tensor) -> Tensor:
        """Response of the decays alone to a step of 1 at time 0, at times from 0 on in µs."""
        main = torch.exp(-time_us / self.log_decay_us.exp())
        step = main
        for weight, tau in zip(self.decay_weights, self.fast_times_us, strict=True):
            step = step + weight * (torch.exp(-time_us / tau) - main)
        return step

    @torch.no_grad()
    def named(self) -> dict[str, tuple[str, float]]:
        """Fitted parameters by name, with the unit at its end: label and value of each.

        A label is the name of the tensor and the place in it, as ``"slow_weights.1"``.
        """
        poles = enumerate(self.log_poles_ns.exp().tolist(), 1)
        falling = enumerate(sorted(poles, key=lambda pole: -pole[1]), 1)
        told = {f"pole_{i}_ns": (f"log_poles_ns.{k}", tau) for i, (k, tau) in falling}
        slow = zip(self.slow_ns.tolist(), self.slow_weights.tolist(), strict=True)
        for i, (tau, weight) in enumerate(slow, 1):
            told[f"slow_{tau:g}_ns"] = f"slow_weights.{i}", weight
        told["decay_us"] = "log_decay_us.1", float(self.log_decay_us.exp())
        fast = zip(self.fast_times_us.tolist(), self.decay_weights.tolist(), strict=True)
        for i, (tau, weight) in enumerate(fast, 1):
            share = f"decay_{tau:g}_us"
            if self.config.free_decays:
                told[f"fast_decay_{i}_us"] = f"log_fast_decays_us.{i}", tau
                share = f"fast_decay_{i}_share"
            told[share] = f"decay_weights.{i}", weight
        if len(self.ringing):
            mhz, damping_ns = self.log_ringing.exp().tolist()
            sine, cosine = self.ringing.tolist()
            told["ringing_mhz"] = "log_ringing.1", mhz
            told["ringing_damping_ns"] = "log_ringing.2", damping_ns
            told["ringing_sine"] = "ringing.1", sine
            told["ringing_cosine"] = "ringing.2", cosine
        stretch = {} if self.drift is None else self.drift.describe()
        for i, (name, value) in enumerate(stretch.items(), 1):
            told[name] = f"drift.stretch.{i}", value
        return told

    def describe(self) -> dict[str, float]:
        """Fitted parameters by name, with the unit at the end of the name.

        ``deviation`` is the largest one of the step response.
        """
        told = {name: value for name, (_, value) in self.named().items()}
        if self.config.deviations:
            told["deviation"] = float(self.deviation.abs().max())
        return told


def _spline(frequency: Tensor) -> Tensor:
    """Spectrum of the cardinal cubic spline at frequencies in units of the sampling rate.

    Unser, Aldroubi and Eden, IEEE Trans. Signal Process. 41 (1993) 821.
    """
    spline: Tensor = torch.sinc(frequency) ** 4 * 3 / (2 + torch.cos(2 * math.pi * frequency))
    return spline


def current_spectrum(windows: Tensor, padded: int, dt_ns: float) -> Tensor:
    """Spectra of the current of windows (..., samples) within records."""
    current = torch.diff(windows, dim=-1, prepend=torch.zeros_like(windows[..., :1]))
    current = nn.functional.pad(current, (padding(dt_ns)[0], 0))
    spectrum: Tensor = torch.fft.rfft(current, padded)
    return spectrum


def padded_length(length: int) -> int:
    """Length of the Fourier transform of a record of this length, in samples."""
    return fast_length(math.ceil(MIN_FACTOR * length))


def fast_length(least: int) -> int:
    """Smallest even number of `least` or more with no prime factors except 2, 3 and 5."""
    return 2 * int(scipy.fft.next_fast_len((least + 1) // 2, real=True))
