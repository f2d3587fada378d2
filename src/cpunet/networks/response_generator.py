"""A readout chain with the noise of its baselines: what turns simulation into data."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.networks.response import ElectronicsResponse
from cpunet.recipes.schema import ResponseConfig

NOISE_BINS = 4097  # of a spectrum as `BaselineNoise` measures it


class ResponseGenerator(nn.Module):
    """A response and a spectrum of noise, saved together.

    Parameters
    ----------
    config
        Of the response.
    dt_ns
        Sampling period in ns.
    """

    noise_density: Tensor
    n_baselines: Tensor

    def __init__(self, config: ResponseConfig, dt_ns: float) -> None:
        super().__init__()
        self.response = ElectronicsResponse(config, dt_ns)
        # (prepared units x keV)^2, see `BaselineNoise.density`
        self.register_buffer("noise_density", torch.zeros(NOISE_BINS, dtype=torch.float64))
        self.register_buffer("n_baselines", torch.zeros((), dtype=torch.long))

    def set_noise(self, noise: BaselineNoise) -> None:
        """Take over a measured spectrum."""
        self.noise_density.copy_(torch.from_numpy(noise.density_of(2 * (NOISE_BINS - 1))))
        self.n_baselines.fill_(noise.n_baselines)

    @property
    def noise(self) -> BaselineNoise:
        """The noise, to be drawn from."""
        return BaselineNoise(
            self.noise_density.cpu().numpy(),
            2 * (NOISE_BINS - 1),
            float(self.response.dt_ns),
            int(self.n_baselines),
        )

    def forward(self, windows: Tensor) -> Tensor:
        """Noise-free records of prepared simulated windows, as `ElectronicsResponse`."""
        records: Tensor = self.response(windows)
        return records
