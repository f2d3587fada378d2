"""A closed-form start for residual generators, from the two sets' own averages.

Response and alignment together slow the edge of a measured pulse and move it by tens
of samples: the slow top of a measured pulse reaches 99.9 % of its maximum long after
its edge, that of a simulated one at once.  A network that starts from the identity
has to learn this against its cycle loss, and for many seeds fails to in the time
available on a laptop.  The delay, the level and how much slower the edge is need not
be learned: they are medians and means of the two sets.  Only the shape remains.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cpunet.networks.positional_unet import SKIP_KERNEL, smoothed
from cpunet.training.cyclegan import CycleGan

SLOPE_SAMPLES = 3  # over which the steepest slope is taken: enough to suppress the noise
MOST = 2000  # maximum number of pulses: enough for a median
BISECTIONS = 20


def match_skips(model: CycleGan, sim: Tensor, data: Tensor, align_sample: int) -> None:
    """Set the skips of REN and IREN so that both start near the other side's pulses.

    Parameters
    ----------
    model
        Model with residual generators; other generators are not changed.
    sim, data
        Prepared pulses, shape (n, 1, samples).
    align_sample
        Sample at which both are aligned; after it, the mean measured pulse defines
        the level (simulated ones are flat at 1).
    """
    if not (model.ren.residual and model.iren.residual):
        return
    mean = data.mean(dim=(0, 1))
    level = mean.clone()
    level[:align_sample] = mean[align_sample]
    sim, data = sim[:MOST], data[:MOST]
    kernel = _matching_kernel(sim * level, data)
    slow = smoothed(sim, kernel)
    advance = round(float(_half_maximum(slow).median() - _half_maximum(data).median()))
    model.ren.skip.set(level, advance, kernel)
    index = torch.arange(len(level), device=level.device) - advance
    # undoing the smoothing would amplify noise: sharpening is left to the network
    model.iren.skip.set(1 / level[index.clamp(0, len(level) - 1)], -advance)


def _matching_kernel(sim: Tensor, data: Tensor) -> Tensor:
    """Gaussian that makes the median steepest slope of `sim` that of `data`."""
    wanted = _steepest(data)
    low, high = 0.0, SKIP_KERNEL / 6  # three standard deviations to either side
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        too_steep = _steepest(smoothed(sim, gaussian(middle, sim.device))) > wanted
        low, high = (middle, high) if too_steep else (low, middle)
    return gaussian(low, sim.device)


def gaussian(sigma: float, device: torch.device) -> Tensor:
    """Normalised Gaussian of `sigma` samples, shape (SKIP_KERNEL,)."""
    offset = torch.arange(SKIP_KERNEL, device=device) - SKIP_KERNEL // 2
    kernel = torch.exp(-0.5 * (offset / max(sigma, 1e-3)) ** 2)
    return kernel / kernel.sum()


def _steepest(pulses: Tensor) -> float:
    """Median over pulses of the largest rise within `SLOPE_SAMPLES` samples."""
    rise = pulses[..., SLOPE_SAMPLES:] - pulses[..., :-SLOPE_SAMPLES]
    return float(rise.amax(dim=(1, 2)).median())


def _half_maximum(pulses: Tensor) -> Tensor:
    """First sample at or above half of the maximum, shape (n,)."""
    waveforms = pulses[:, 0]
    half = 0.5 * waveforms.amax(dim=1, keepdim=True)
    return (waveforms >= half).int().argmax(dim=1).double()
