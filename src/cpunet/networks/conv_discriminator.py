"""A discriminator of strided convolutions, as an alternative to the published GRU.

It sees the pulse and its current, halves their length layer by layer, and averages over the
remaining samples.  Unlike in a GRU, no step waits for another, and it has second derivatives on
every device, which a gradient penalty needs and cuDNN's GRU lacks.  There is no batch norm, so
the result for a pulse does not depend on the rest of its batch.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from cpunet.recipes.network_settings import ConvConfig

WIDEST = 8  # times the width of the first layer
LEAK = 0.2


class ConvDiscriminator(nn.Module):
    """Rate how measured (or simulated) a pulse looks; `forward` returns logits."""

    def __init__(self, config: ConvConfig) -> None:
        super().__init__()
        self.current_gain = config.current_gain
        widths = [2, *(config.width * min(2**n, WIDEST) for n in range(config.layers))]
        self.layers = nn.ModuleList(
            nn.Conv1d(a, b, config.kernel, stride=2, padding=config.kernel // 2)
            for a, b in itertools.pairwise(widths)
        )
        self.outlet = nn.Linear(widths[-1], 1)

    def forward(self, pulses: Tensor) -> Tensor:
        """Logits, shape (batch,), of pulses of shape (batch, 1, samples)."""
        current = nn.functional.pad(pulses.diff(dim=2), (1, 0))
        x = torch.cat([pulses, self.current_gain * current], dim=1)  # (batch, 2, samples)
        for layer in self.layers:
            x = nn.functional.leaky_relu(layer(x), LEAK)
        logits = self.outlet(x.mean(dim=2))
        return logits[:, 0]  # type: ignore[no-any-return]

    def fix_statistics(self) -> None:
        """Do nothing: no statistics of the batch are used."""
