r"""The recipe ``cpunet``'s REN: a learned step response behind a Positional U-Net.

Linear electronics are a step response, whatever their circuit.  It is learned as deviations
from a smooth step of two poles, which are a Gaussian process: smooth in
:math:`\operatorname{arsinh}(t / 96\,\mathrm{ns})`, so that details are possible at the edge
and not later, where they would be noise, and zero before the charge.  Pulses are aligned and do
not tell a delay; without this, a fit takes one and makes the edge of waves.  The fit moves in
the leading eigenvectors of its covariance.  Each of these coordinates has a prior of mean 0 and
width 1.

What no linear response can do stands in front of it, as in the detector: a Positional U-Net
changes how fast the clock of a simulated pulse runs, and blurs it; see `DriftUNet`.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.interpolate
import scipy.special
import torch
from torch import Tensor, nn

from cpunet.electronics.finishing import padding
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_layer import (
    MIN_FACTOR,
    ElectronicsResponse,
    Readout,
    at_times,
    fast_length,
    padded_length,
)
from cpunet.recipes.schema import LearnedConfig, PunetConfig, ResponseConfig

# Knots of the step response in ns: every APART or nearly so from FIRST to DENSE, then SPARSE
# logarithmic ones up to LAST, and an exponential beyond.  Coordinates are the leading
# eigenvectors of their covariance: denser knots would give those of the edge more weight.
FIRST, DENSE, LAST, APART, SPARSE = -128.0, 768.0, 7040.0, 16.0, 20
# The prior: width of the deviations from the base, factor of it about time 0 and how far that
# reaches in ns, time from which times count logarithmically, and correlation length.
WIDTH, EDGE, EDGE_NS, LINEAR_NS, LENGTH = 0.03, 5.0, 192.0, 96.0, 0.5
ONSET_NS = 8.0  # about time 0, in which the deviations begin
# A ringing: width, time in ns after which it has decayed, and correlation length in ns.
RINGING, RINGING_NS, RINGING_LENGTH_NS, RINGING_FROM_NS = 0.05, 400.0, 56.0, -128.0
RINGING_COORDINATES = 24
POLES_RISE = 1.146  # rise of two equal poles from 10 to 50 % in units of one of them
LONGEST_US = 1e5  # decay of a base whose data do not decay
# The U-Net sees this much of a pulse, this part of it before the half maximum; the largest
# logarithm of the rate, and the time over which it is smoothed; the largest variance of blur.
SEEN_NS, SEEN_BEFORE = 4096.0, 0.625
MAX_LOG_RATE, SMOOTH_NS, MAX_BLUR_NS2 = 0.3, 80.0, 768.0
LOW = 0.02  # charge from which the time of a pulse counts


class StepResponse(Readout):
    """Learned response to a step of charge.

    Parameters
    ----------
    config
        Number of coordinates, and whether there is a ringing.
    dt_ns
        Sampling period of the pulses in ns.
    """

    base: Tensor
    basis: Tensor
    lags: Tensor
    drift = None

    def __init__(self, config: LearnedConfig, dt_ns: float) -> None:
        super().__init__(dt_ns)
        apart = max(1, round(APART / dt_ns))
        dense = apart * np.arange(
            round(FIRST / dt_ns / apart), round(DENSE / dt_ns / apart) + 1
        )
        sparse = np.round(np.geomspace(DENSE, LAST, SPARSE) / dt_ns).astype(int)
        lags = np.unique(np.concatenate([dense, sparse]))
        double = torch.float64
        time = np.arange(lags[0], lags[-1] + 1)
        self.register_buffer("lags", torch.from_numpy(time.astype(float)), persistent=False)
        self.register_buffer("base", torch.zeros(len(time), dtype=double))
        self.last = len(time) - int(lags[-1] - lags[-4]) - 1  # from which the decay is taken
        covariance, n = _prior(lags * dt_ns), config.coordinates
        if config.ringing:
            covariance, n = covariance + _ringing(lags * dt_ns), n + RINGING_COORDINATES
        variances, axes = np.linalg.eigh(covariance)
        scaled = axes[:, ::-1][:, :n] * np.sqrt(np.maximum(variances[::-1][:n], 0.0))
        place = np.arcsinh(lags * dt_ns / LINEAR_NS)
        between = scipy.interpolate.CubicSpline(place, scaled)
        smooth = between(np.arcsinh(time * dt_ns / LINEAR_NS))
        self.register_buffer("basis", torch.from_numpy(smooth), persistent=False)
        self.coordinates = nn.Parameter(torch.zeros(n, dtype=double))

    def set_base(self, pole_ns: float, slope: float) -> None:
        """Begin with a base: both its poles in ns, and the slope per sample of its decay.

        It is a chain like any other, since charge is interpolated between its samples there.
        """
        dt_us = 1e-3 * float(self.dt_ns)
        config = ResponseConfig(
            name="response",
            poles_ns=(pole_ns, pole_ns),
            slow_ns=(),
            decay_us=min(LONGEST_US, dt_us / max(-slope, 1e-9)),
            fast_decays_us=(),
            free_decays=False,
            ringing_mhz=None,
            ringing_ns=1.0,
            drift_terms=0,
            deviations=False,
        )
        padded, first = padded_length(2 * len(self.lags) + 1000), int(self.lags[0])
        with torch.no_grad():
            chain = ElectronicsResponse(config, float(self.dt_ns)).transfer(padded)
            kernel = torch.fft.irfft(chain, padded)
        self.base.copy_(torch.cat([kernel[first:], kernel[: len(self.base) + first]]))
        self.coordinates.data.zero_()

    @torch.no_grad()
    def pole_ns(self) -> float:
        """Poles in ns of a base with the same rise from 10 to 50 %."""
        step = self.step(int(self.lags[-1]) + 1)[None]
        early, late = (_crossing(step / step.max(), level) for level in (0.1, 0.5))
        return float(late - early) * float(self.dt_ns) / POLES_RISE

    def step(self, samples: int) -> Tensor:
        """Response to a step at sample 0, from `FIRST` on, shape (samples - first,)."""
        early = self.base + self.basis @ self.coordinates
        lever = len(early) - 1 - self.last
        rate = torch.log((early[-1] / early[self.last]).clamp(0.5, 1.2)) / lever
        first = int(self.lags[0])
        after = torch.arange(1, samples - first - len(early) + 1).to(early)
        late = early[-1] * torch.exp(rate * after)
        return torch.cat([early, late])[: samples - first]

    def transfer(self, padded: int) -> Tensor:
        """Response to a step of charge at sample 0, as a spectrum of `padded` samples."""
        step = self.step(int(padded / MIN_FACTOR) - padding(float(self.dt_ns))[0])
        before = -int(self.lags[0])
        gap = step.new_zeros(padded - len(step))
        # times before 0 stand at the end
        spectrum: Tensor = torch.fft.rfft(torch.cat([step[before:], gap, step[:before]]))
        return spectrum

    @torch.no_grad()
    def describe(self) -> dict[str, float]:
        """Properties of the step response by name, with the unit at the end of the name."""
        step = self.step(int(self.lags[-1]) + 1)
        dt_ns, top = float(self.dt_ns), int(step.argmax())
        rise = [int((step >= part * step[top]).int().argmax()) for part in (0.1, 0.9)]
        end = torch.log(step[-1] / step[self.last]) / (len(step) - 1 - self.last)
        return {
            "rise_ns": dt_ns * (rise[1] - rise[0]),
            "overshoot": float(step[top]) - 1.0,
            "decay_us": -1e-3 * dt_ns / float(end),
        }


class DriftUNet(nn.Module):
    """A Positional U-Net that changes the clock of simulated pulses, and blurs them.

    Its first output is the logarithm of the local rate of the clock, which is smoothed, bounded
    and summed outwards from the half maximum, so that the order in time is kept.  Its second
    one, averaged with the current, is the variance of a blur of the whole pulse: a charge cloud
    that is larger (or smaller) than simulated.

    Parameters
    ----------
    width
        Width of the U-Net's first layer.
    dt_ns
        Sampling period in ns.
    """

    share: Tensor
    smoothing: Tensor

    def __init__(self, width: int, dt_ns: float) -> None:
        super().__init__()
        self.dt_ns = dt_ns
        self.length = 16 * max(1, round(SEEN_NS / dt_ns / 16))
        self.before = round(SEEN_BEFORE * self.length)
        self.max_blur = MAX_BLUR_NS2 / dt_ns**2
        config = PunetConfig(name="punet", width=width, dropout=0.0)
        self.network = PositionalUNet(config, self.length)
        self.network.outlet = nn.Conv1d(self.network.outlet.in_channels, 2, 1)
        for values in self.network.outlet.parameters():
            nn.init.zeros_(values)
        reach = max(1, round(3 * SMOOTH_NS / dt_ns))
        smoothing = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) * dt_ns / SMOOTH_NS) ** 2)
        self.register_buffer("smoothing", (smoothing / smoothing.sum())[None, None], False)
        self.register_buffer("share", torch.ones(()))  # of what the network does

    def forward(self, windows: Tensor) -> Tensor:
        """Change pulses of height 1, shape (batch, samples)."""
        return self.changed(windows)[0]

    def changed(self, windows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Changed pulses, logarithms of the rate (batch, seen), and variances of the blur."""
        length = windows.shape[1]
        sample = torch.arange(length, device=windows.device)
        half = ((windows < 0.5) * (sample + 1)).amax(dim=1, keepdim=True) - 1
        seen = torch.arange(self.length, device=windows.device) - self.before
        part = windows.gather(1, (half + seen).clamp(0, length - 1))
        out = self.network((2 * part - 1)[:, None], mean=True)  # (batch, 2, seen)
        reach = self.smoothing.shape[-1] // 2
        smooth = nn.functional.pad(out[:, :1], (reach, reach), mode="replicate")
        smooth = nn.functional.conv1d(smooth, self.smoothing)[:, 0]
        log_rate = self.share * MAX_LOG_RATE * torch.tanh(smooth)
        current = torch.diff(part, dim=1).clamp_min(0)
        blur = (out[:, 1, 1:] * current).sum(dim=1) / current.sum(dim=1).clamp_min(1e-6)
        blur = self.share * self.max_blur * torch.tanh(blur)
        clock = torch.cumsum(torch.exp(-log_rate), dim=1)
        late = clock - clock[:, self.before : self.before + 1] - seen
        at = (sample - half + self.before).clamp(0, self.length - 1)
        moved = at_times(windows, sample + late.gather(1, at))
        return _blurred(moved, blur), log_rate, blur

    @torch.no_grad()
    def effect(self, windows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What it does with each pulse, shapes (batch,).

        Returns
        -------
        tuple
            Time from 2 to 98 % of the charge in ns as simulated, its relative change, and the
            variance of the blur in ns².
        """
        changed, _, blur = self.eval().changed(windows)
        before, after = (_crossing(p, 1 - LOW) - _crossing(p, LOW) for p in (windows, changed))
        return before * self.dt_ns, after / before - 1, blur.double() * self.dt_ns**2


class LearnedResponse(Readout):
    """A `StepResponse` behind a `DriftUNet`, if there is one.

    Parameters
    ----------
    config
        What is learned.
    dt_ns
        Sampling period of the pulses in ns.
    """

    drift: DriftUNet | None

    def __init__(self, config: LearnedConfig, dt_ns: float) -> None:
        super().__init__(dt_ns)
        self.config = config
        self.step = StepResponse(config, dt_ns)
        self.drift = DriftUNet(config.width, dt_ns) if config.drift else None

    def drifted(self, windows: Tensor) -> Tensor:
        """Simulated pulses as they enter the readout."""
        if self.drift is None:
            return windows
        changed: Tensor = self.drift(windows)
        return changed

    def transfer(self, padded: int) -> Tensor:
        """Response to a step of charge at sample 0, as a spectrum of `padded` samples."""
        return self.step.transfer(padded)

    def describe(self) -> dict[str, float]:
        """Properties of the step response by name, with the unit at the end of the name."""
        return self.step.describe()


def _prior(time_ns: np.ndarray) -> np.ndarray:
    """Covariance of the deviations of a step response from its base."""
    place = np.arcsinh(time_ns / LINEAR_NS)
    width = WIDTH * (1 + (EDGE - 1) * np.exp(-((time_ns / EDGE_NS) ** 2)))
    width = width * scipy.special.expit(time_ns / ONSET_NS)
    near = np.exp(-0.5 * ((place[:, np.newaxis] - place) / LENGTH) ** 2)
    return np.asarray(width[:, np.newaxis] * width * near)


def _ringing(time_ns: np.ndarray) -> np.ndarray:
    """Covariance of a ringing."""
    size = RINGING * np.exp(-np.abs(time_ns) / RINGING_NS) * (time_ns > RINGING_FROM_NS)
    near = np.exp(-0.5 * ((time_ns[:, np.newaxis] - time_ns) / RINGING_LENGTH_NS) ** 2)
    return np.asarray(size[:, np.newaxis] * size * near)


def _crossing(windows: Tensor, level: float) -> Tensor:
    """Time in samples at which rising pulses (batch, samples) pass a level, shape (batch,)."""
    after = (windows < level).sum(dim=1, keepdim=True).clamp(1, windows.shape[1] - 1)
    low, high = (windows.double().gather(1, at) for at in (after - 1, after))
    return (after - (high - level) / (high - low).clamp_min(1e-9))[:, 0]


def _blurred(windows: Tensor, variance: Tensor) -> Tensor:
    """Pulses convolved with Gaussians of a variance in samples², negative to sharpen."""
    current = torch.diff(windows, dim=1, prepend=torch.zeros_like(windows[:, :1]))
    padded = fast_length(windows.shape[1] + 64)
    omega = 2 * math.pi * torch.fft.rfftfreq(padded, device=windows.device)
    damping = torch.exp((-0.5 * omega**2 * variance[:, None]).clamp(-4, 4))
    current = torch.fft.irfft(torch.fft.rfft(current, padded) * damping, padded)
    return torch.cumsum(current[:, : windows.shape[1]], dim=1)
