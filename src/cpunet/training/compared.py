"""What a training step compares: pulses with what they should be, and with real ones."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

Pair = tuple[Tensor, Tensor]


class Judged(NamedTuple):
    """Pulses as a judge sees them, each (batch, 1, samples)."""

    real: Tensor
    fake: Tensor


class Compared(NamedTuple):
    """Of each loss, what was made and what was wanted.

    Parameters
    ----------
    identity_data, identity_sim, cycle_forward, cycle_backward
        Pulses, and those that they are to be.
    judged_data, judged_sim
        Of each side.
    tolerance
        What of the deviations of ``cycle_backward`` counts for nothing; None for nothing.
    """

    identity_data: Pair
    identity_sim: Pair
    cycle_forward: Pair
    cycle_backward: Pair
    judged_data: Judged
    judged_sim: Judged
    tolerance: Tensor | None = None
