"""A closed-form start for residual generators, from the two sets' own averages.

Response and alignment together move the edge of a measured pulse by tens of
samples: the slow top of a measured pulse reaches 99.9 % of its maximum long after
its edge, that of a simulated one at once.  A network that starts from the
identity has to learn this move against its cycle loss and mostly fails in the
time a laptop has.  The move and the level need no learning: they are medians and
means of the two sets.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cpunet.training.cyclegan import CycleGan


def match_skips(model: CycleGan, sim: Tensor, data: Tensor, align_sample: int) -> None:
    """Set the skips of REN and IREN so that both start near the other side's pulses.

    Parameters
    ----------
    model
        With residual generators; others are left as they are.
    sim, data
        Prepared pulses, shape (n, 1, samples).
    align_sample
        Sample at which both are aligned; after it, the mean measured pulse gives
        the level (simulated ones are flat at 1).
    """
    if not (model.ren.residual and model.iren.residual):
        return
    advance = round(float(_half_maximum(sim).median() - _half_maximum(data).median()))
    mean = data.mean(dim=(0, 1))
    level = mean.clone()
    level[:align_sample] = mean[align_sample]
    model.ren.skip.set(level, advance)
    index = torch.arange(len(level), device=level.device) - advance
    model.iren.skip.set(1 / level[index.clamp(0, len(level) - 1)], -advance)


def _half_maximum(pulses: Tensor) -> Tensor:
    """First sample at or above half of the maximum, shape (n,)."""
    waveforms = pulses[:, 0]
    half = 0.5 * waveforms.amax(dim=1, keepdim=True)
    return (waveforms >= half).int().argmax(dim=1).double()
