"""A readout chain and a small network that corrects the edge of its records.

A chain treats all pulses alike.  If the simulated physics differ from the detector's, the edges
of single-site and multi-site pulses are off by different amounts, which no chain can describe.
The network sees a short stretch of each record around its half maximum, folded into channels,
and returns a time shift for each sample.  The shift times the slope is added to the record, so
that the flat parts (baseline, top and tail) remain those of the chain.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cpunet.networks.linear_inverse import stretch, with_stretch
from cpunet.networks.positional_unet import SLOPE, positional_map
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.recipes.network_settings import ResidualConfig

BEFORE, AFTER = 64, 96  # samples around the half maximum; tail slopes are measured later
FOLD = 8  # samples per step
KERNEL = 5  # steps
RAMP = 16  # samples over which the correction goes to zero at either end
SLOPE_SCALE = 20.0  # steepest slopes are a few hundredths of the height per sample


class RecordCorrection(nn.Module):
    """A network that changes the records of a chain."""

    used: Tensor | bool
    """Whether it changes any records."""

    def corrected(self, records: Tensor) -> tuple[Tensor, Tensor]:
        """Corrected records of any height, shape (batch, samples), and what was added."""
        raise NotImplementedError


class EdgeResidual(RecordCorrection):
    """A U-Net of two levels that corrects records; the correction is zero until trained.

    Parameters
    ----------
    config
        Settings of the network: its width.
    """

    position: Tensor
    taper: Tensor
    used: Tensor

    def __init__(self, config: ResidualConfig) -> None:
        super().__init__()
        width, steps = config.width, (BEFORE + AFTER) // FOLD

        def block(channels_in: int, channels_out: int) -> nn.Sequential:
            return nn.Sequential(
                nn.Conv1d(channels_in, channels_out, KERNEL, padding="same"),
                nn.LeakyReLU(SLOPE, inplace=True),
                nn.Conv1d(channels_out, channels_out, KERNEL, padding="same"),
                nn.LeakyReLU(SLOPE, inplace=True),
            )

        self.inlet = block(2 * FOLD, width)
        self.down = block(width, 2 * width)
        self.up = block(3 * width, width)
        self.outlet = nn.Conv1d(width, FOLD, 1)
        self.register_buffer("position", positional_map(width, steps, 0), persistent=False)
        self.register_buffer("taper", taper(BEFORE + AFTER, RAMP), persistent=False)
        # whether there is anything to add: a network of zeros is not run
        self.register_buffer("used", torch.zeros((), dtype=torch.bool))
        self.clear()

    def clear(self) -> None:
        """Make the correction exactly zero."""
        with torch.no_grad():
            for parameter in self.outlet.parameters():
                parameter.zero_()
        self.used.fill_(False)

    def forward(self, records: Tensor) -> Tensor:
        """Correct records.

        Parameters
        ----------
        records
            Noise-free, of any height, shape (batch, samples).

        Returns
        -------
        Tensor
            Records of the same shape, unchanged outside the stretch around the half maximum.
        """
        if not self.training and not self.used:
            return records
        corrected, _ = self.corrected(records)
        return corrected

    def corrected(self, records: Tensor) -> tuple[Tensor, Tensor]:
        """Corrected records, and what was added in units of each one's maximum."""
        with torch.no_grad():
            height, at = records.max(dim=1, keepdim=True)
            sample = half_sample(records, height, at)
            inside = stretch(records, sample, -BEFORE, AFTER) / height
        added = self.correction(inside)
        return with_stretch(records, sample, -BEFORE, AFTER, added * height), added

    def correction(self, inside: Tensor) -> Tensor:
        """Correction for stretches of height 1, shape (batch, BEFORE + AFTER).

        The network's output is a time in samples.
        """
        slope = torch.diff(inside, dim=1, prepend=inside[:, :1])
        folded = torch.cat([_folded(inside), _folded(SLOPE_SCALE * slope)], dim=1)
        fine = self.inlet(folded) + self.position
        coarse = self.down(nn.functional.avg_pool1d(fine, 2))
        wide = nn.functional.interpolate(coarse, scale_factor=2, mode="nearest")
        out: Tensor = self.outlet(self.up(torch.cat([fine, wide], dim=1)))
        return out.transpose(1, 2).flatten(1) * slope * self.taper


class HybridGenerator(ResponseGenerator):
    """A readout chain with its noise, and a correction of its records.

    Parameters
    ----------
    chain
        Chain whose response and noise are used.
    residual
        The correction.
    """

    def __init__(self, chain: ResponseGenerator, residual: RecordCorrection) -> None:
        nn.Module.__init__(self)  # not the base's: everything it would make exists already
        self.response, self.remains = chain.response, chain.remains
        for name, values in chain.named_buffers(recurse=False):
            self.register_buffer(name, values)
        self.residual = residual

    def forward(self, windows: Tensor) -> Tensor:
        """Noise-free records of prepared simulated windows, as from `ResponseGenerator`."""
        records: Tensor = self.residual(self.response(windows))
        return records


def half_sample(records: Tensor, height: Tensor, at: Tensor) -> Tensor:
    """Last sample below half of each maximum before it, (n,), given its `height` and `at`."""
    index = torch.arange(records.shape[1], device=records.device)
    below = (records < 0.5 * height) & (index < at)
    return ((below * (index + 1)).amax(dim=1) - 1).clamp_min(0)


def _folded(stretches: Tensor) -> Tensor:
    """(batch, samples) → (batch, FOLD, samples / FOLD)."""
    # without the number of pulses, which would be fixed in an exported graph
    folded: Tensor = stretches.unflatten(1, (-1, FOLD))  # type: ignore[no-untyped-call]
    return folded.transpose(1, 2)


def taper(length: int, ramp: int) -> Tensor:
    """1 except within `ramp` samples of either end, where it goes to zero smoothly."""
    samples = torch.arange(length)
    edge = torch.minimum(samples + 0.5, length - 0.5 - samples)
    return torch.sin(0.5 * torch.pi * (edge / ramp).clamp(max=1)) ** 2
