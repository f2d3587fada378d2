"""Between simulation and data: a readout chain with its noise, and the linear inverse."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from cpunet.electronics.baseline_noise import KINDS, BaselineNoise, record_samples
from cpunet.electronics.drawn_pile_up import DrawnTails
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.schema import MatchingConfig, ResponseConfig


class KeptNoise(nn.Module):
    """Spectra of noise as buffers.

    Parameters
    ----------
    dt_ns
        Sampling period in ns.
    """

    noise_continua: Tensor
    noise_lines: Tensor
    noise_shares: Tensor
    n_baselines: Tensor

    def __init__(self, dt_ns: float) -> None:
        super().__init__()
        self._dt_ns = float(dt_ns)
        bins = record_samples(dt_ns) // 2 + 1
        # (prepared units x keV)^2, see `BaselineNoise`; kinds that are absent have a share of 0
        for name in ("noise_continua", "noise_lines"):
            self.register_buffer(name, torch.zeros(KINDS, bins))
        self.register_buffer("noise_shares", torch.zeros(KINDS, dtype=torch.float64))
        self.register_buffer("n_baselines", torch.zeros((), dtype=torch.long))

    @property
    def noise_dt_ns(self) -> float:
        """Sampling period of the noise in ns."""
        return self._dt_ns

    def set_noise(self, noise: BaselineNoise) -> None:
        """Store a measured spectrum."""
        one = noise.density_of(record_samples(self._dt_ns))[np.newaxis]
        continua = one if noise.kinds is None else noise.kinds
        lines = np.zeros_like(continua) if noise.lines is None else noise.lines
        shares = np.ones(1) if noise.shares is None else noise.shares
        for buffer, values in (
            (self.noise_continua, continua),
            (self.noise_lines, lines),
            (self.noise_shares, shares),
        ):
            buffer.zero_()
            buffer[: len(values)] = torch.from_numpy(values).to(buffer)
        self.n_baselines.fill_(noise.n_baselines)

    @property
    def noise(self) -> BaselineNoise:
        """The noise, to be drawn from."""
        there = self.noise_shares.cpu().numpy() > 0
        continua, lines, shares = (
            buffer.cpu().numpy()[there].astype(float)
            for buffer in (self.noise_continua, self.noise_lines, self.noise_shares)
        )
        return BaselineNoise(
            shares @ (continua + lines),
            record_samples(self._dt_ns),
            self.noise_dt_ns,
            int(self.n_baselines),
            continua,
            lines,
            shares,
        )


AFTER_NS = 2720.0  # from the half maximum until charge and slow response have arrived
MIN_LEVEL = 1e-3  # below it, there is no pulse


class LinearInverse(nn.Module):
    """Prepared measured windows → simulation-like, almost noise-free pulses.

    Of all linear functions of a measured pulse it is the one that comes closest to the charge
    pulse on average (the Wiener filter of these pulses in this noise).  Windows are aligned at
    half maximum by whole samples: shifts by fractions of a sample would smooth the steep part,
    and degrade the map.

    A new one holds zeros: load weights, or let `cpunet.training.inverse` fit them.

    Parameters
    ----------
    length
        Samples of a window.
    config
        Comparison by which the response was matched, which says where windows are scaled.

    Attributes
    ----------
    before, after : int
        Samples on either side of the half maximum that are translated.
    baseline, level : tuple of int
        First sample and stop, from the half maximum, of the parts that are scaled to 0 and 1.
    """

    half_height: Tensor
    mean_in: Tensor
    mean_out: Tensor
    weights: Tensor

    def __init__(self, length: int, config: MatchingConfig) -> None:
        super().__init__()
        self.length = length
        self.before, stop = config.baseline
        self.after = min(config.samples(AFTER_NS), config.after)
        self.baseline = (-self.before, -stop)
        self.level = (config.after - config.level_samples, config.after)
        n = self.before + self.after
        # the first: half of the maximum, the same number for all windows
        shapes = {"half_height": (), "mean_in": (n,), "mean_out": (n,), "weights": (n, n)}
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    def forward(self, windows: Tensor) -> Tensor:
        """Translate measured windows.

        Parameters
        ----------
        windows
            Prepared measured pulses, shape (n, length).

        Returns
        -------
        Tensor
            Shape (n, length): pulses within 0 … 1 at the times of the measured ones,
            to be aligned and normalised like simulated ones.  NaN where a window has NaN.
        """
        sample = self.half_sample(windows)
        inside = self.region(windows, sample) - self.mean_in
        # charge is within 0 … 1; ripples beyond that would affect the scale of the pulses
        pulses = (self.mean_out + inside @ self.weights.T).clamp(0, 1)
        # 0 before the region and 1 after it: one sample on either side stands for the rest
        pulses = nn.functional.pad(pulses, (1, 0), value=0.0)
        pulses = nn.functional.pad(pulses, (0, 1), value=1.0)
        start = 1 + self.before - sample
        return stretch(pulses, start, 0, self.length).to(windows.dtype)

    def half_sample(self, windows: Tensor) -> Tensor:
        """Last sample below half of the maximum before the maximum, shape (n,)."""
        index = torch.arange(windows.shape[1], device=windows.device)
        highest = windows.argmax(dim=1, keepdim=True)
        below = (windows < self.half_height) & (index < highest)
        return ((below * (index + 1)).amax(dim=1) - 1).clamp_min(0)

    def region(self, windows: Tensor, sample: Tensor) -> Tensor:
        """The translated stretch of each window, with baseline 0 and level 1, float64.

        Parameters
        ----------
        windows
            Shape (n, length).
        sample
            Sample of the half maximum of each.
        """
        base, level = self.base_and_level(windows, sample)
        inside = stretch(windows, sample, -self.before, self.after)
        return (inside - base[:, None]) / level.clamp_min(MIN_LEVEL)[:, None]

    def base_and_level(self, windows: Tensor, sample: Tensor) -> tuple[Tensor, Tensor]:
        """Mean before each pulse, and mean of its tail above that."""
        base = stretch(windows, sample, *self.baseline).double().mean(dim=1)
        tail = stretch(windows, sample, *self.level).double().mean(dim=1)
        return base, tail - base


def stretch(pulses: Tensor, sample: Tensor, first: int, stop: int) -> Tensor:
    """Samples `first` to `stop`, counted from `sample` of each pulse; edges are repeated.

    Parameters
    ----------
    pulses
        Shape (n, samples).
    sample
        Sample from which is counted, shape (n,).
    """
    index = sample[:, None] + torch.arange(first, stop, device=pulses.device)
    return pulses.gather(1, index.clamp(0, pulses.shape[1] - 1))


class ResponseGenerator(KeptNoise):
    """A response and a spectrum of noise, saved together.

    Parameters
    ----------
    config
        Configuration of the response.
    dt_ns
        Sampling period in ns.
    """

    tails: DrawnTails | None = None
    """Pile-up tails, which are added to records with the noise."""

    def __init__(self, config: ResponseConfig, dt_ns: float) -> None:
        super().__init__(dt_ns)
        self.response = ElectronicsResponse(config, dt_ns)

    @property
    def noise_dt_ns(self) -> float:
        """Current sampling period of the response in ns."""
        return float(self.response.dt_ns)

    def forward(self, windows: Tensor) -> Tensor:
        """Noise-free records of prepared simulated windows, as from `ElectronicsResponse`."""
        records: Tensor = self.response(windows)
        return records
