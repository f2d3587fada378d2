"""Modules that can be exported: what a backend does without noise, as a graph of tensors."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from cpunet.networks.drift_clock import DriftClock
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_generator import ResponseGenerator


class NetworkGraph(PositionalUNet):
    """A Positional U-Net whose latent draw is an input."""

    def __init__(self, network: PositionalUNet) -> None:
        nn.Module.__init__(self)  # all attributes of the base are taken over
        self.__dict__.update(copy.deepcopy(network).__dict__)

    def forward(self, windows: Tensor, epsilon: Tensor) -> Tensor:  # type: ignore[override]
        """Windows (batch, samples) and epsilon (batch, channels, samples / 16) → windows."""
        # the base passes its generator on to `_latent`; here this argument is the draw itself
        drawn = cast(torch.Generator, epsilon)
        return super().forward(windows[:, None], generator=drawn)[:, 0]

    def _latent(self, x: Tensor, generator: Any, mean: bool) -> Tensor:
        del mean
        centre: Tensor = self.latent_mean(x)
        return centre + torch.exp(0.5 * self.latent_log_variance(x)) * cast(Tensor, generator)


class ChainGraph(nn.Module):
    """A readout chain as a matrix, with a stretch of the drift if there is one.

    The chain is linear.  A product with its responses to single samples gives the same
    records as its Fourier transforms, which few formats support.
    """

    matrix: Tensor

    def __init__(self, chain: ResponseGenerator, length: int) -> None:
        super().__init__()
        linear = copy.deepcopy(chain.response)
        self.drift, linear.drift = linear.drift, None
        self.dt_ns = float(linear.dt_ns)
        with torch.inference_mode():
            matrix = linear(torch.eye(length, device=linear.dt_ns.device))
        self.register_buffer("matrix", matrix.clone().cpu())

    def forward(self, windows: Tensor) -> Tensor:
        """Windows (batch, samples) → noise-free records (batch, 200 + samples + 400)."""
        if isinstance(self.drift, DriftClock):
            windows = self.drift(windows, dt_ns=self.dt_ns)
        elif self.drift is not None:
            windows = self.drift(windows)
        return windows @ self.matrix


@dataclass(frozen=True)
class Graph:
    """A module to export, with the names of its inputs and output, and inputs for a check."""

    module: nn.Module
    inputs: tuple[str, ...]
    output: str
    example: Callable[[int], tuple[Tensor, ...]]
    expected: Callable[[tuple[Tensor, ...]], Tensor]


def example_windows(length: int) -> Callable[[int], Tensor]:
    """Prepared pulses with edges of several widths and positions."""

    def windows(n: int) -> Tensor:
        rng = np.random.default_rng(n)
        width, at = rng.uniform(2, 12, (n, 1)), length // 2 - rng.uniform(10, 60, (n, 1))
        charge = 1 / (1 + np.exp(-(np.arange(length) - at) / width))
        return torch.from_numpy(charge.astype(np.float32))

    return windows
