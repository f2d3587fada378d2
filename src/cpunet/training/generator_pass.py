"""A generator's forward pass, in the precision and the form that a recipe asks for.

Weights, optimiser, losses and discriminators stay in float32 whatever the passes are in.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor, nn

Pass = Callable[[Tensor], Tensor]


def generator_pass(
    network: nn.Module, precision: Literal["float32", "bf16"], *, compiled: bool
) -> Pass:
    """Make a function equivalent to the network's ``forward``, shape (batch, 1, samples).

    Parameters
    ----------
    network
        Generator; it is not modified.
    precision
        ``"bf16"`` does convolutions and their gradients in bfloat16 (torch.autocast).
    compiled
        Whether to compile it with torch.compile; this takes half a minute at the first call.
    """
    run: Pass = torch.compile(network) if compiled else network
    if precision == "float32":
        return run

    def in_bf16(pulses: Tensor) -> Tensor:
        with torch.autocast(pulses.device.type, torch.bfloat16):
            return run(pulses).to(pulses.dtype)

    return in_bf16
