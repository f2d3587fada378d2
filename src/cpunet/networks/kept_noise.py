"""Baseline noise that is saved with a network's weights, to be drawn from later."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from cpunet.electronics.baseline_noise import KINDS, BaselineNoise

NOISE_BINS = 4097  # in a spectrum as measured by `BaselineNoise`


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
        # (prepared units x keV)^2, see `BaselineNoise`; kinds that are absent have a share of 0
        for name in ("noise_continua", "noise_lines"):
            self.register_buffer(name, torch.zeros(KINDS, NOISE_BINS))
        self.register_buffer("noise_shares", torch.zeros(KINDS, dtype=torch.float64))
        self.register_buffer("n_baselines", torch.zeros((), dtype=torch.long))

    @property
    def noise_dt_ns(self) -> float:
        """Sampling period of the noise in ns."""
        return self._dt_ns

    def set_noise(self, noise: BaselineNoise) -> None:
        """Store a measured spectrum."""
        one = noise.density_of(2 * (NOISE_BINS - 1))[np.newaxis]
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
            2 * (NOISE_BINS - 1),
            self.noise_dt_ns,
            int(self.n_baselines),
            continua,
            lines,
            shares,
        )
