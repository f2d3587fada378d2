"""Pulses that a training step compares: outputs with their targets, and with real pulses."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

Pair = tuple[Tensor, Tensor]


class Judged(NamedTuple):
    """Pulses as a discriminator sees them, each (batch, 1, samples)."""

    real: Tensor
    fake: Tensor


class Compared(NamedTuple):
    """Outputs and targets of each loss.

    Parameters
    ----------
    identity_data, identity_sim, cycle_forward, cycle_backward
        Output pulses and their targets.
    judged_data, judged_sim
        Real and translated pulses for the discriminator of each side.
    tolerance
        Part of each deviation of ``cycle_backward`` that is ignored; None to ignore nothing.
    """

    identity_data: Pair
    identity_sim: Pair
    cycle_forward: Pair
    cycle_backward: Pair
    judged_data: Judged
    judged_sim: Judged
    tolerance: Tensor | None = None
