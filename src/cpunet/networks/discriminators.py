"""The discriminator: a GRU with attention (paper, section 2.2.2).

Each sample of a pulse is looked up in a table of learned vectors, a
bidirectional GRU reads them, and attention weighs the time steps.  With 1,000
rows of 64 and 64 hidden units it has the published 130,817 trainable parameters.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from cpunet.recipes.schema import GruConfig

# Cycles of the initial sines over the whole table.  Slow ones are nearly monotonic, so
# that the slope at one value points towards distant ones; with 1 to 16 cycles the
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
    Real and translated pulses must then be in one batch, or the difference between
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
        self.norm = nn.BatchNorm1d(both)
        self.outlet = nn.Linear(2 * both, 1)

    def forward(self, pulses: Tensor) -> Tensor:
        """Logits, shape (batch,), of pulses of shape (batch, 1, samples)."""
        vectors = self.embedding(self._fraction(pulses[:, 0]))  # (batch, samples, dim)
        steps = vectors.unflatten(1, (-1, self.samples_per_step)).flatten(2)
        outputs, final = self.gru(steps)  # (batch, steps, both), (2, batch, hidden)
        final = torch.cat([final[0], final[1]], dim=1)  # (batch, both)
        # s(t) = softmax[I(t) A F]; the root keeps the softmax from saturating at the start
        query = self.attention(final)[:, :, None]  # (batch, both, 1)
        score = torch.softmax(outputs @ query / math.sqrt(final.shape[1]), dim=1)
        context = (score * outputs).sum(dim=1)  # (batch, both)
        logits = self.outlet(torch.cat([self.norm(context), final], dim=1))
        return logits[:, 0]  # type: ignore[no-any-return]

    def _fraction(self, x: Tensor) -> Tensor:
        """Position of each value in the table, 0…1, shape (batch, samples)."""
        if self.value_range is not None:
            low, high = self.value_range
            return (x - low) / (high - low)
        least, most = x.amin(dim=1, keepdim=True), x.amax(dim=1, keepdim=True)
        return (x - least) / (most - least).clamp(min=torch.finfo(x.dtype).eps)

    def fix_statistics(self) -> None:
        """Use the running statistics until the next ``train()``."""
        self.norm.eval()  # not the GRU: cuDNN's has no backward pass in evaluation
