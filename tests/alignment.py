"""Align pulses at half maximum, in plain tensors: what compiled loops are compared with."""

from __future__ import annotations

import torch
from torch import Tensor

from cpunet.networks.linear_inverse import stretch
from cpunet.recipes.training_settings import MatchingConfig


def crossing(records: Tensor, level: float, last: Tensor) -> tuple[Tensor, Tensor]:
    """Last upward crossing of a level before a sample, by linear interpolation.

    Parameters
    ----------
    records
        Shape (pulses, samples).
    level
        Level that is crossed.
    last
        Sample of each pulse from which the search goes backward, shape (pulses,).

    Returns
    -------
    tuple of Tensor
        Time of each crossing in samples, and the sample before it.
    """
    index = torch.arange(records.shape[1] - 1, device=records.device)
    below = (records[:, :-1] < level) & (index < last[:, None])
    before = ((below * (index + 1)).amax(dim=1) - 1).clamp_min(0)
    low = records.gather(1, before[:, None])[:, 0]
    high = records.gather(1, before[:, None] + 1)[:, 0]
    return before + (level - low) / (high - low).clamp_min(1e-6), before


def at_half_maximum(
    records: Tensor, level: float, last: int, config: MatchingConfig, tail_level: float
) -> Tensor:
    """Align records, subtract the baseline and scale.

    Parameters
    ----------
    records
        Shape (pulses, samples), of about the height of prepared pulses.
    level
        Half of the maximum of the data's mean pulse, the same number for all sets.
    last
        Sample from which the crossing is searched for backward.
    config, tail_level
        Ranges of baseline and level, and the value that the level is scaled to.

    Returns
    -------
    Tensor
        Windows of ``before + after`` samples around the crossing, shifted by fractions of a
        sample.
    """
    whole = torch.full((len(records),), last, device=records.device)
    _, sample = crossing(records, level, whole)
    first, stop = config.baseline
    # twice, since baseline and level are relative to the crossing of the normalised record
    for _ in range(2):
        base = stretch(records, sample, -first, -stop).mean(dim=1, keepdim=True)
        records = records - base
        tail = stretch(records, sample, config.after - config.level_samples, config.after)
        records = records * (tail_level / tail.mean(dim=1, keepdim=True))
        time, sample = crossing(records, level, sample + 20)
    start = time.floor()
    fraction = (time - start)[:, None]
    window = stretch(records, start.long(), -config.before, config.after + 1)
    return window[:, :-1] * (1 - fraction) + window[:, 1:] * fraction
