"""Linear parts of generators, with gradients: solved, or learned with the networks."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from cpunet.electronics.finishing import padding, record_length
from cpunet.networks.generators import LinearInverse
from cpunet.networks.response_layer import ElectronicsResponse, padded_length
from cpunet.recipes.schema import PreparationConfig

# Of a learned step response: up to which time every sample is free, and the last knot.
DENSE_NS, LAST_NS, KNOTS = 768.0, 7040.0, 20
RISE_NS, MODES = 48.0, 28  # of the two poles it begins with; its free smooth modes
# Size of deviations (edge, rise, tail), their reach, and how smooth they are in asinh(t / T)
SIZES, REACH_NS = (0.12, 0.024, 0.006), (192.0, 1920.0)
CURVED_NS, SMOOTH, WHITE = 96.0, 0.35, 3e-4
NOISE = 3e-3  # of an inverse at first, over the height of a pulse
LATE_NS = 960.0  # at the end of a window, whose mean is 1


class Linear(nn.Module):
    """Charge (n, samples) → records (n, samples with room), behind a step response."""

    def __init__(self, config: PreparationConfig) -> None:
        super().__init__()
        self.config, self.before = config, padding(config.sampled_ns)[0]
        self.length = record_length(config.length, config.sampled_ns)
        self.padded = padded_length(self.length)

    def current(self, charge: Tensor) -> Tensor:
        """Spectra of the current of windows, within records."""
        current = charge.diff(dim=1, prepend=torch.zeros_like(charge[:, :1]))
        spectra: Tensor = torch.fft.rfft(pad(current, (self.before, 0)), self.padded)
        return spectra

    def records(self, charge: Tensor, spectrum: Tensor) -> Tensor:
        """Records behind the response to a step at sample 0 of this spectrum."""
        record: Tensor = torch.fft.irfft(self.current(charge) * spectrum, self.padded)
        stop, c = self.before + self.config.length, self.config  # of the nominal window
        level = record[:, stop - c.tail_samples : stop].mean(dim=1, keepdim=True)
        return record[:, : self.length] * (c.tail_level / level.clamp_min(0.1))


class SolvedResponse(Linear):
    """A fitted response; where it stretches the drift, gradients are those without."""

    solved: Tensor

    def __init__(self, response: ElectronicsResponse, config: PreparationConfig) -> None:
        super().__init__(config)
        spectrum = torch.from_numpy(response.transfer(self.padded)).to(torch.complex64)
        self.register_buffer("solved", spectrum, persistent=False)
        self.drifted = response.drifted

    def forward(self, charge: Tensor) -> Tensor:
        moved = torch.from_numpy(self.drifted(charge.detach().cpu().numpy())).to(charge)
        return self.records(charge + (moved - charge).detach(), self.solved)


class SolvedInverse(nn.Module):
    """`LinearInverse`, with gradients."""

    mean_in: Tensor
    mean_out: Tensor
    weights: Tensor

    def __init__(self, inverse: LinearInverse) -> None:
        super().__init__()
        self.inverse = inverse
        for name in ("mean_in", "mean_out", "weights"):
            values = torch.from_numpy(getattr(inverse, name)).float()
            self.register_buffer(name, values, persistent=False)

    def forward(self, windows: Tensor) -> Tensor:
        f, index = self.inverse, torch.arange(windows.shape[1], device=windows.device)
        with torch.no_grad():  # as `LinearInverse.region`
            below = (windows < float(f.half_height)) & (index < windows.argmax(1, keepdim=True))
            at = ((below * (index + 1)).amax(dim=1, keepdim=True) - 1).clamp_min(0)
        inside, before, tail = (
            windows.gather(1, (at + index.new_tensor(range(*ends))).clamp(0, len(index) - 1))
            for ends in ((-f.before, f.after), f.baseline, f.level)
        )
        base = before.mean(dim=1, keepdim=True)
        level = tail.mean(dim=1, keepdim=True) - base
        inside = (inside - base) / level.clamp_min(0.1)
        pulses = (self.mean_out + (inside - self.mean_in) @ self.weights.T).clamp(0, 1)
        whole = pad(pad(pulses, (1, 0)), (0, 1), value=1.0)
        return whole.gather(1, (index - at + f.before + 1).clamp(0, whole.shape[1] - 1))


class LearnedResponse(Linear):
    """A step response that moves in smooth modes, most where it rises.

    It is 0 before the step.  Critics see aligned pulses: a response that is free before the
    step, too, can move as a whole, and does so without end, bending its foot.

    Parameters
    ----------
    config
        Preparation of the pulses.
    decay
        Decay of the data per sample, with which it begins.
    """

    begin: Tensor
    modes: Tensor
    between: Tensor

    def __init__(self, config: PreparationConfig, decay: float) -> None:
        super().__init__(config)
        dt = config.sampled_ns
        dense, last = (round(ns / dt) for ns in (DENSE_NS, LAST_NS))
        later = np.geomspace(dense, last, KNOTS).round().astype(int)
        knots, lags = np.unique(np.r_[:dense, later]), np.arange(self.length - self.before)
        ns = knots * dt
        u, sizes = np.arcsinh(ns / CURVED_NS), np.full(len(ns), SIZES[2])
        for size, reach in zip(SIZES, REACH_NS, strict=False):
            sizes += size * np.exp(-((ns / reach) ** 2))
        like = np.exp(-0.5 * ((u[:, None] - u) / SMOOTH) ** 2)
        prior = sizes[:, None] * sizes * like + WHITE**2 * np.eye(len(u))
        values, vectors = np.linalg.eigh(prior)
        rise = ns / RISE_NS
        begin = (1 - (1 + rise) * np.exp(-rise)) * np.exp(-decay * knots)
        modes = vectors[:, -MODES:] * np.sqrt(values[-MODES:])
        between = np.stack([np.interp(lags, knots, unit) for unit in np.eye(len(knots))], 1)
        for name, array in (("begin", begin), ("modes", modes), ("between", between)):
            self.register_buffer(name, torch.from_numpy(array).float())
        self.sizes = nn.Parameter(torch.zeros(MODES))
        self.late = int((lags > knots[-1]).sum())
        self.spacing = float(knots[-1] - knots[-4])

    def step(self) -> Tensor:
        """Response to a step at sample 0, from then on."""
        knots = self.begin + self.modes @ self.sizes
        rate = torch.log((knots[-1] / knots[-4]).clamp(0.5, 1.2)) / self.spacing
        late = torch.arange(1.0, 1 + self.late, device=rate.device)  # goes on as it ends
        free = (self.between @ knots)[: -self.late]
        return torch.cat([free, knots[-1] * torch.exp(rate * late)])

    def forward(self, charge: Tensor) -> Tensor:
        return self.records(charge, torch.fft.rfft(self.step(), self.padded))


class LearnedInverse(nn.Module):
    """What undoes a learned response up to a learned noise: windows → charge, 0 … 1."""

    def __init__(self, response: LearnedResponse) -> None:
        super().__init__()
        self.of = [response]  # a list: its parameters are REN's
        self.log_noise = nn.Parameter(torch.tensor(math.log(NOISE)))

    def forward(self, windows: Tensor) -> Tensor:
        r, noise = self.of[0], self.log_noise.exp()
        step = r.step().detach()
        impulse = torch.fft.rfft(step.diff(prepend=step.new_zeros(1)), r.padded)
        undone = impulse.conj() * (1 + noise) / (impulse.abs().square() + noise)
        charge: Tensor = torch.fft.irfft(r.current(windows) * undone, r.padded).cumsum(dim=1)
        charge = charge[:, r.before : r.before + r.config.length]
        base = charge[:, : r.config.baseline_samples].mean(dim=1, keepdim=True)
        late = charge[:, -r.config.samples(LATE_NS) :].mean(dim=1, keepdim=True)
        return (charge - base) / (late - base).clamp_min(0.1)
