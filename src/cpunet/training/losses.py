"""The eight losses of the paper (section 3.4.1 and its table of losses)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from cpunet.recipes.training_settings import LossConfig


def window_weights(config: LossConfig) -> Tensor:
    """Weight of each sample in the L1 losses, shape (samples,).

    Baseline, rising edge and tail each count as their weight times the *mean*
    absolute difference in their window, whatever its length.
    """
    windows = (
        (config.baseline_len, config.baseline_weight),
        (config.rising_edge_len, config.rising_edge_weight),
        (config.tail_len, config.tail_weight),
    )
    return torch.cat([torch.full((length,), weight / length) for length, weight in windows])


def weighted_l1(
    pulses: Tensor, others: Tensor, weights: Tensor, tolerance: Tensor | None = None
) -> Tensor:
    """Weighted absolute difference, per pulse, then averaged over the batch.

    Parameters
    ----------
    pulses, others
        Shape (batch, 1, samples).
    weights
        From `window_weights`, shape (samples,).
    tolerance
        Part of each difference that is ignored, per pulse, shape (batch, 1, 1).
    """
    apart = (pulses - others).abs()
    if tolerance is not None:
        apart = (apart - tolerance).clamp_min(0)
    return (apart * weights).sum(dim=-1).mean()


def real_loss(logits: Tensor) -> Tensor:
    """Binary cross-entropy of calling these pulses real."""
    return binary_cross_entropy_with_logits(logits, torch.ones_like(logits))


def fake_loss(logits: Tensor) -> Tensor:
    """Binary cross-entropy of calling these pulses translated."""
    return binary_cross_entropy_with_logits(logits, torch.zeros_like(logits))
