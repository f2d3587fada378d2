"""The networks of the CycleGAN: the Positional U-Net, and the discriminator.

The Positional U-Net: the paper's generator (section 2.2.1).

A one-dimensional U-Net of four levels with sine and cosine maps of the sample
index added to its layers, so that it knows where on the pulse it is (a plain
U-Net does not reproduce the decaying tail), and a random latent layer at the
bottom.  At width 40 it has the published 7,213,781 trainable parameters.

The discriminator: a GRU with attention (paper, section 2.2.2).

Each sample of a pulse is looked up in a table of learned vectors, a
bidirectional GRU reads them, and attention weighs the time steps.  With 1,000
rows of 64 and 64 hidden units it has the published 130,817 trainable parameters.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from cpunet.recipes.schema import GruConfig, PunetConfig

FIRST_KERNEL, SECOND_KERNEL, SLOPE = 11, 7, 0.01


def double_convolution(*channels: int, residual: bool) -> nn.Sequential:
    """Two convolutions, each with a leaky rectifier and, if not in a residual, batch norm.

    `channels` are those that go in, those between the convolutions, and those that come out.
    """
    layers: list[nn.Module] = []
    for i, o, kernel in zip(
        channels, channels[1:], (FIRST_KERNEL, SECOND_KERNEL), strict=False
    ):
        layers += [
            nn.Conv1d(i, o, kernel, padding="same", bias=residual),
            nn.Identity() if residual else nn.BatchNorm1d(o),
            nn.LeakyReLU(SLOPE, inplace=True),
        ]
    return nn.Sequential(*layers)


class PositionalMap(nn.Module):
    """Add sines and cosines of the sample index to a layer's output, then drop out.

    Channel pairs carry the Transformer's frequencies ``10000 ** (-2k / channels)``
    (Vaswani et al. 2017); `offset` is added to the sample index.
    """

    values: Tensor

    def __init__(self, channels: int, samples: int, offset: int, dropout: float) -> None:
        super().__init__()
        position = torch.arange(samples, dtype=torch.float64) + offset
        pair = torch.arange(0, channels, 2, dtype=torch.float64)
        phase = 10000.0 ** (-pair / channels)[:, None] * position  # (channels / 2, samples)
        pairs = torch.stack([phase.sin(), phase.cos()], dim=1)  # (channels / 2, 2, samples)
        values = pairs.flatten(0, 1)[None, :channels].float()
        # a function of the architecture, not of the training: not saved
        self.register_buffer("values", values, persistent=False)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor) -> Tensor:
        return self.dropout(x + self.values)  # type: ignore[no-any-return]


class PositionalUNet(nn.Module):
    """Translate pulses with a Positional U-Net.

    Parameters
    ----------
    config
        Width of the first layer (40 in the paper) and the dropout fraction.
    length
        Samples of a pulse; a multiple of 16, since the network halves it four times.
    residual
        For what is added to a pulse: of charge and current, without batch norm, dropout or
        draw, and 0 at first.
    """

    def __init__(self, config: PunetConfig, length: int, *, residual: bool = False) -> None:
        super().__init__()
        self.width, self.residual = config.width, residual
        m = config.width
        self.inlet = double_convolution(2 if residual else 1, m, m, residual=residual)
        self.down = nn.ModuleList(
            double_convolution(i, o, o, residual=residual)
            for i, o in ((m, 2 * m), (2 * m, 4 * m), (4 * m, 8 * m), (8 * m, 8 * m))
        )
        self.latent_mean = nn.Conv1d(8 * m, 8 * m, 1)
        if not residual:
            self.latent_log_variance = nn.Conv1d(8 * m, 8 * m, 1)
        self.up = nn.ModuleList(
            double_convolution(2 * c, c, o, residual=residual)
            for c, o in ((8 * m, 4 * m), (4 * m, 2 * m), (2 * m, m), (m, m // 2))
        )
        self.outlet = nn.Conv1d(m // 2, 1, 1)
        if residual:
            nn.init.zeros_(self.outlet.weight)
            nn.init.zeros_(self.outlet.bias)  # type: ignore[arg-type]

        dropout = 0.0 if residual else config.dropout
        self.maps_down = nn.ModuleList(
            PositionalMap(factor * m, length // factor, 0, dropout) for factor in (1, 2, 4, 8)
        )
        self.map_latent = PositionalMap(8 * m, length // 16, 0, dropout)
        # no map after the last step up; the offsets are those of the paper's network
        levels = (4 * m, 8, 4 * m), (2 * m, 4, 2 * m), (m, 2, 2 * m)
        self.maps_up = nn.ModuleList(
            PositionalMap(channels, length // factor, offset, dropout)
            for channels, factor, offset in levels
        )

    def forward(
        self,
        pulses: Tensor,
        *,
        generator: torch.Generator | None = None,
        mean: bool = False,
        epsilon: Tensor | None = None,
    ) -> Tensor:
        """Translate pulses.

        Parameters
        ----------
        pulses
            Shape (batch, 1, samples); (batch, 2, samples) of a residual.
        generator
            Source of the latent noise, for reproducible draws.
        mean
            Take the latent mean instead of a draw: the same output every time.
        epsilon
            The draw itself, shape (batch, channels, samples / 16).

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
        centre = self.latent_mean(x)
        if mean or self.residual:
            x = self.map_latent(centre)
        else:  # from the latent normal distribution (reparameterised: gradients flow)
            spread = torch.exp(0.5 * self.latent_log_variance(x))
            if epsilon is None:
                epsilon = torch.empty_like(centre).normal_(generator=generator)
            x = self.map_latent(centre + spread * epsilon)
        for level, block in enumerate(self.up):
            x = nn.functional.interpolate(x, scale_factor=2, mode="linear", align_corners=True)
            x = block(torch.cat([skips[3 - level], x], dim=1))
            if level < 3:
                x = self.maps_up[level](x)
        return self.outlet(x)  # type: ignore[no-any-return]


# Cycles of the initial sines over the whole table.  Slow ones are nearly monotonic, so
# that the slope at a value points towards distant values; with 1 to 16 cycles the
# generator's edge did not move.
LOWEST, HIGHEST = 0.1, 2.0


class InterpolatedEmbedding(nn.Module):
    """A table of vectors, read by linear interpolation between its rows.

    At whole codes it equals the usual look-up; between them it is differentiable
    with respect to the code, so that an adversarial loss reaches the generator
    (an integer look-up has no gradient).

    The rows start as sines of the code with random phases: neighbouring codes get
    similar vectors.  Independent random rows would make the slope between
    neighbours, and with it the gradient handed to the generator, pure noise.
    """

    def __init__(self, rows: int, dim: int) -> None:
        super().__init__()
        code = torch.linspace(0, 1, rows)[:, None]
        frequency = LOWEST * (HIGHEST / LOWEST) ** torch.rand(dim)
        phase = 2 * math.pi * torch.rand(dim)
        self.weight = nn.Parameter(torch.sin(2 * math.pi * frequency * code + phase))

    def forward(self, fraction: Tensor) -> Tensor:
        """Look up values in [0, 1], shape (...), and return vectors, shape (..., dim)."""
        last = self.weight.shape[0] - 1
        code = fraction.clamp(0, 1) * last
        lower = code.detach().floor().clamp(max=last - 1)
        part = (code - lower)[..., None]
        # NaN has no row, but `part` passes it on, so that the training notices it
        index = lower.nan_to_num().long()
        below = nn.functional.embedding(index, self.weight)
        above = nn.functional.embedding(index + 1, self.weight)
        return torch.lerp(below, above, part)


class GruDiscriminator(nn.Module):
    """Rate how measured (or simulated) a pulse looks.

    `forward` returns logits: the log of the odds that a pulse is real.

    In training mode, the batch norm on the context uses the statistics of the batch.
    Real and translated pulses must then be in the same batch, or the difference between
    the two is normalised away.
    """

    def __init__(self, config: GruConfig) -> None:
        super().__init__()
        both = 2 * config.hidden
        self.embedding = InterpolatedEmbedding(config.embedding_rows, config.embedding_dim)
        self.value_range = config.value_range
        self.samples_per_step = config.samples_per_step
        self.gru = nn.GRU(
            config.embedding_dim * config.samples_per_step,
            config.hidden,
            batch_first=True,
            bidirectional=True,
        )
        self.attention = nn.Linear(both, both, bias=False)
        self.norm = nn.BatchNorm1d(both) if config.batch_norm else nn.Identity()
        self.outlet = nn.Linear(2 * both, 1)

    def forward(self, pulses: Tensor) -> Tensor:
        """Logits, shape (batch,), of pulses or views of shape (batch, samples)."""
        low: Any = pulses.amin(dim=1, keepdim=True)
        high: Any = pulses.amax(dim=1, keepdim=True).clamp(low + torch.finfo(pulses.dtype).eps)
        if self.value_range is not None:
            low, high = self.value_range
        position = (pulses - low) / (high - low)  # in the table, 0…1
        vectors = self.embedding(position)  # (batch, samples, dim)
        steps = vectors.unflatten(1, (-1, self.samples_per_step)).flatten(2)
        outputs, final = self.gru(steps)  # (batch, steps, both), (2, batch, hidden)
        final = torch.cat([final[0], final[1]], dim=1)  # (batch, both)
        # s(t) = softmax[I(t) A F]; the root keeps the softmax from saturating at the start
        query = self.attention(final)[:, :, None]  # (batch, both, 1)
        score = torch.softmax(outputs @ query / math.sqrt(final.shape[1]), dim=1)
        context = (score * outputs).sum(dim=1)  # (batch, both)
        logits = self.outlet(torch.cat([self.norm(context), final], dim=1))
        return logits[:, 0]  # type: ignore[no-any-return]
