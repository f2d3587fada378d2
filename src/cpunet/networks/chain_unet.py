"""A readout chain corrected by a Positional U-Net, and the inverse of both.

The chain does what filters can.  The U-Net sees each pulse around its half maximum, where its
positional maps are meaningful, and returns a time shift for each sample.  The shift times the
slope is added to the pulse, so that the flat parts (baseline, top and tail) remain those of the
chain.  A U-Net that starts at zero starts with the chain's translation.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cpunet.networks.hybrid import RecordCorrection, half_sample, taper
from cpunet.networks.linear_inverse import LinearInverse, stretch, with_stretch
from cpunet.networks.positional_unet import PositionalUNet

RAMP = 24  # samples over which a correction goes to zero at either end
TAIL = 100  # samples at the end of a stretch whose mean gives a record's height
MIN_HEIGHT = 1e-3


class UNetCorrection(RecordCorrection):
    """Correction that a residual U-Net adds to records around their half maximum.

    Parameters
    ----------
    unet
        Residual U-Net for `before` + `after` samples.
    before, after
        Samples of the stretch on either side of the half maximum.
    tail_level
        Tail level of prepared pulses, to which the end of a stretch is scaled for the U-Net.
    """

    taper: Tensor
    used = True

    def __init__(
        self, unet: PositionalUNet, before: int, after: int, tail_level: float
    ) -> None:
        super().__init__()
        self.unet = unet
        self.before, self.after, self.tail_level = before, after, tail_level
        self.register_buffer("taper", taper(before + after, RAMP), persistent=False)

    def forward(self, records: Tensor) -> Tensor:
        """Correct noise-free records of any height, shape (batch, samples)."""
        return self.corrected(records)[0]

    def corrected(self, records: Tensor) -> tuple[Tensor, Tensor]:
        """Corrected records, and what was added in units of prepared pulses."""
        highest, at = records.max(dim=1, keepdim=True)
        sample = half_sample(records, highest, at)
        inside = stretch(records, sample, -self.before, self.after)
        height = inside[:, -TAIL:].mean(dim=1, keepdim=True) / self.tail_level
        height = height.clamp_min(MIN_HEIGHT)
        added = self.added(inside / height)
        changed = with_stretch(records, sample, -self.before, self.after, added * height)
        return changed, added

    def added(self, inside: Tensor) -> Tensor:
        """Correction for stretches of prepared height, shape (batch, before + after)."""
        # in evaluation mode, use the latent mean: the same record every time
        out = self.unet(inside[:, None], mean=not self.training)[:, 0]
        slope = torch.diff(inside, dim=1, prepend=inside[:, :1])
        change: Tensor = (out - inside) * slope * self.taper
        return change


class InverseUNet(nn.Module):
    """Measured windows → pulses as simulated, without noise: linear inverse and U-Net.

    Parameters
    ----------
    inverse
        Inverse of the chain.
    unet
        Residual U-Net for `before` + `after` samples.
    before, after
        Samples on either side of the half maximum of the measured pulse.
    """

    def __init__(
        self, inverse: LinearInverse, unet: PositionalUNet, before: int, after: int
    ) -> None:
        super().__init__()
        self.inverse, self.unet = inverse, unet
        self.before, self.after = before, after

    def forward(self, windows: Tensor) -> Tensor:
        """Pulses about the half maximum of each window, shape (batch, before + after)."""
        pulses, _ = self.located(windows)
        return pulses

    def located(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        """The same, and the sample of each window at which its stretch begins."""
        sample = self.inverse.half_sample(windows)
        begun = stretch(self.inverse(windows), sample, -self.before, self.after)
        out = self.unet(begun[:, None], mean=not self.training)[:, 0]
        return out, sample - self.before
