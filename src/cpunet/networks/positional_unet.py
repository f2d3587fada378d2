"""The Positional U-Net: the paper's generator (section 2.2.1).

A one-dimensional U-Net of four levels with sine and cosine maps of the sample
index added to its layers, so that it knows where on the pulse it is (a plain
U-Net does not reproduce the decaying tail), and a random latent layer at the
bottom.  At width 40 it has the published 7,213,781 trainable parameters.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from cpunet.recipes.network_settings import PunetConfig

FIRST_KERNEL, SECOND_KERNEL, SLOPE = 11, 7, 0.01


def double_convolution(channels_in: int, channels_out: int, channels_mid: int) -> nn.Sequential:
    """Two convolutions, each with batch norm and a leaky rectifier."""
    return nn.Sequential(
        nn.Conv1d(channels_in, channels_mid, FIRST_KERNEL, padding="same", bias=False),
        nn.BatchNorm1d(channels_mid),
        nn.LeakyReLU(SLOPE, inplace=True),
        nn.Conv1d(channels_mid, channels_out, SECOND_KERNEL, padding="same", bias=False),
        nn.BatchNorm1d(channels_out),
        nn.LeakyReLU(SLOPE, inplace=True),
    )


def positional_map(channels: int, samples: int, offset: int) -> Tensor:
    """Sines and cosines of the sample index, shape (1, channels, samples).

    Channel pairs carry the Transformer's frequencies ``10000 ** (-2k / channels)``
    (Vaswani et al. 2017); `offset` is added to the sample index.
    """
    position = torch.arange(samples, dtype=torch.float64) + offset
    pair = torch.arange(0, channels, 2, dtype=torch.float64)
    phase = 10000.0 ** (-pair / channels)[:, None] * position  # (channels / 2, samples)
    pairs = torch.stack([phase.sin(), phase.cos()], dim=1)  # (channels / 2, 2, samples)
    return pairs.flatten(0, 1)[None, :channels].float()


class PositionalMap(nn.Module):
    """Add a positional map to a layer's output, then drop out."""

    values: Tensor

    def __init__(self, channels: int, samples: int, offset: int, dropout: float) -> None:
        super().__init__()
        # a function of the architecture, not of the training: not saved
        self.register_buffer(
            "values", positional_map(channels, samples, offset), persistent=False
        )
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor) -> Tensor:
        return self.dropout(x + self.values)  # type: ignore[no-any-return]


SKIP_KERNEL = 65  # samples; about 1 µs at 16 ns


class Skip(nn.Module):
    """Input of a residual generator, smoothed, shifted and scaled, which it corrects.

    ``gain[t] * (kernel * pulse)[t + advance]``, with the edge values repeated beyond the
    ends. It starts as the identity; `set` provides a better start.
    """

    gain: Tensor
    advance: Tensor
    kernel: Tensor
    index: Tensor

    def __init__(self, length: int) -> None:
        super().__init__()
        kernel = torch.zeros(SKIP_KERNEL)
        kernel[SKIP_KERNEL // 2] = 1.0
        self.register_buffer("gain", torch.ones(length))
        self.register_buffer("advance", torch.zeros((), dtype=torch.long))
        self.register_buffer("kernel", kernel)
        self.register_buffer("index", torch.arange(length), persistent=False)

    def set(self, gain: Tensor, advance: int, kernel: Tensor | None = None) -> None:
        """Set the gain of each output sample, the advance in samples and the smoothing."""
        self.gain.copy_(gain)
        self.advance.fill_(advance)
        if kernel is not None:
            self.kernel.copy_(kernel)

    def forward(self, pulses: Tensor) -> Tensor:
        source = (self.index + self.advance).clamp(0, len(self.index) - 1)
        return self.gain * smoothed(pulses, self.kernel)[..., source]


def smoothed(pulses: Tensor, kernel: Tensor) -> Tensor:
    """Convolve pulses (batch, 1, samples) with a kernel of odd length, edges repeated."""
    half = len(kernel) // 2
    padded = nn.functional.pad(pulses, (half, half), mode="replicate")
    return nn.functional.conv1d(padded, kernel[None, None])


class PositionalUNet(nn.Module):
    """Translate pulses with a Positional U-Net.

    Parameters
    ----------
    config
        Width of the first layer (40 in the paper) and the dropout fraction.
    length
        Samples of a pulse; a multiple of 16, since the network halves it four times.

    Raises
    ------
    ValueError
        If the length is not a multiple of 16.
    """

    def __init__(self, config: PunetConfig, length: int) -> None:
        super().__init__()
        self.width = m = config.width
        if length % 16:
            raise ValueError(f"the pulse length {length} is no multiple of 16")
        self.length = length

        def block(channels_in: int, channels_out: int) -> nn.Sequential:
            return double_convolution(channels_in, channels_out, channels_out)

        self.inlet = block(1, m)
        self.down = nn.ModuleList(
            [block(m, 2 * m), block(2 * m, 4 * m), block(4 * m, 8 * m), block(8 * m, 8 * m)]
        )
        self.latent_mean = nn.Conv1d(8 * m, 8 * m, 1)
        self.latent_log_variance = nn.Conv1d(8 * m, 8 * m, 1)
        self.up = nn.ModuleList(
            [
                double_convolution(2 * c, o, c)
                for c, o in ((8 * m, 4 * m), (4 * m, 2 * m), (2 * m, m), (m, m // 2))
            ]
        )
        self.outlet = nn.Conv1d(m // 2, 1, 1)
        self.residual = config.residual
        if config.residual:
            self.skip = Skip(length)
            nn.init.zeros_(self.outlet.weight)
            nn.init.zeros_(cast(Tensor, self.outlet.bias))

        def maps(*levels: tuple[int, int, int]) -> nn.ModuleList:
            return nn.ModuleList(
                PositionalMap(channels, length // factor, offset, config.dropout)
                for channels, factor, offset in levels
            )

        self.maps_down = maps((m, 1, 0), (2 * m, 2, 0), (4 * m, 4, 0), (8 * m, 8, 0))
        self.map_latent = PositionalMap(8 * m, length // 16, 0, config.dropout)
        # no map after the last step up
        self.maps_up = maps((4 * m, 8, 4 * m), (2 * m, 4, 2 * m), (m, 2, 2 * m))

    def forward(
        self, pulses: Tensor, *, generator: torch.Generator | None = None, mean: bool = False
    ) -> Tensor:
        """Translate pulses.

        Parameters
        ----------
        pulses
            Shape (batch, 1, samples).
        generator
            Source of the latent noise, for reproducible draws.
        mean
            Take the latent mean instead of a draw: the same output every time.

        Returns
        -------
        Tensor
            Shape (batch, 1, samples).
        """
        x = self.maps_down[0](self.inlet(pulses))  # (batch, m, samples)
        skips = [x]
        for block, position in zip(self.down[:3], self.maps_down[1:], strict=True):
            x = position(block(nn.functional.max_pool1d(x, 2)))
            skips.append(x)
        x = self.down[3](nn.functional.max_pool1d(x, 2))  # (batch, 8m, samples / 16)
        x = self.map_latent(self._latent(x, generator, mean))
        for level, block in enumerate(self.up):
            x = nn.functional.interpolate(x, scale_factor=2, mode="linear", align_corners=True)
            x = block(torch.cat([skips[3 - level], x], dim=1))
            if level < 3:
                x = self.maps_up[level](x)
        x = cast(Tensor, self.outlet(x))
        return self.skip(pulses) + x if self.residual else x

    def _latent(self, x: Tensor, generator: torch.Generator | None, mean: bool) -> Tensor:
        """Draw from the latent normal distribution (reparameterised: gradients flow)."""
        centre: Tensor = self.latent_mean(x)
        if mean:
            return centre
        spread = torch.exp(0.5 * self.latent_log_variance(x))
        noise = torch.empty_like(centre).normal_(generator=generator)
        return centre + spread * noise
