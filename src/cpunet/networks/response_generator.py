"""A readout chain with its baseline noise, which turns simulation into data."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from cpunet.electronics.drawn_tails import DrawnTails, TraceNoise
from cpunet.networks.kept_noise import KeptNoise
from cpunet.networks.learned_response import LearnedResponse
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.network_settings import LearnedConfig, ResponseConfig


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

    def __init__(self, config: ResponseConfig | LearnedConfig, dt_ns: float) -> None:
        super().__init__(dt_ns)
        self.response: Any = (
            LearnedResponse(config, dt_ns)
            if isinstance(config, LearnedConfig)
            else ElectronicsResponse(config, dt_ns)
        )

    @property
    def noise_dt_ns(self) -> float:
        """Current sampling period of the response in ns."""
        return float(self.response.dt_ns)

    @property
    def trace_noise(self) -> TraceNoise:
        """The noise, and tails if there are any."""
        return TraceNoise(self.noise, self.tails)

    def forward(self, windows: Tensor) -> Tensor:
        """Noise-free records of prepared simulated windows, as from `ElectronicsResponse`."""
        records: Tensor = self.response(windows)
        return records
