"""Several GRUs, and both directions of each, in one walk over time.

A GRU is slow on short batches because its steps wait for each other, not because of their
arithmetic.  GRUs of one size that read inputs of one length walk together here: one small
matrix product per step for all.  The backward pass knows all gates beforehand, so that its
steps are one product and three sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

_DIRECTIONS = ("", "_reverse")


def run_together(
    grus: Sequence[nn.GRU], inputs: Sequence[Tensor]
) -> list[tuple[Tensor, Tensor]]:
    """What each of some bidirectional GRUs of one layer gives for its input.

    Parameters
    ----------
    grus
        Of one size, ``batch_first``.
    inputs
        Of each, shape (batch, steps, features).

    Returns
    -------
    list of (Tensor, Tensor)
        Of each, the outputs (batch, steps, 2 · hidden) and the last states (2, batch, hidden),
        as the GRU itself would give them.  There is no second derivative.
    """
    projected, kernels, biases = [], [], []
    for gru, given in zip(grus, inputs, strict=True):
        by_time = given.transpose(0, 1).contiguous()
        for direction in _DIRECTIONS:
            kernel_in, kernel, bias_in, bias = (
                getattr(gru, f"{name}_l0{direction}")
                for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
            )
            gates = nn.functional.linear(by_time, kernel_in, bias_in)
            projected.append(gates.flip(0) if direction else gates)
            kernels.append(kernel.T)
            biases.append(bias)
    states: Tensor = _Chains.apply(  # type: ignore[no-untyped-call]
        torch.stack(projected, 1), torch.stack(kernels), torch.stack(biases)[:, None]
    )
    results = []
    for pair in torch.split(states, 2, dim=1):
        forth, back = pair.unbind(1)
        outputs = torch.cat([forth, back.flip(0)], dim=2).transpose(0, 1)
        results.append((outputs, torch.stack([forth[-1], back[-1]])))
    return results


class _Chains(torch.autograd.Function):
    """Gates' inputs (steps, chains, batch, 3 · hidden) → states, the same but of hidden."""

    @staticmethod
    def forward(ctx: Any, gates: Tensor, kernel: Tensor, bias: Tensor) -> Tensor:
        steps, chains, batch, triple = gates.shape
        hidden = triple // 3
        # the state before each step, and the last
        states = gates.new_zeros(steps + 1, chains, batch, hidden)
        both = gates[..., : 2 * hidden].clone()  # reset and update gates
        new = gates[..., 2 * hidden :].clone()
        recalled = torch.empty_like(new)  # what the state says before it is reset
        for step in range(steps):
            before = states[step]
            product = torch.baddbmm(bias, before, kernel)
            reset_update, candidate = both[step], new[step]
            reset_update.add_(product[..., : 2 * hidden]).sigmoid_()
            recalled[step] = product[..., 2 * hidden :]
            candidate.addcmul_(reset_update[..., :hidden], product[..., 2 * hidden :]).tanh_()
            torch.lerp(candidate, before, reset_update[..., hidden:], out=states[step + 1])
        ctx.save_for_backward(states, both, new, recalled, kernel)
        return states[1:].clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, Tensor | None, Tensor | None]:
        states, both, new, recalled, kernel = ctx.saved_tensors
        hidden = new.shape[-1]
        reset, update = both[..., :hidden], both[..., hidden:]
        # all that a gate's slope is to the slope of the state after it
        by_new = (1 - update) * (1 - new.square())
        factors = torch.cat(
            [
                by_new * recalled * reset * (1 - reset),
                (states[:-1] - new) * update * (1 - update),
                by_new * reset,
            ],
            dim=-1,
        )
        factors = factors.view(*new.shape[:-1], 3, hidden)
        back = kernel.transpose(1, 2).contiguous()
        after = slope.clone()
        for step in range(len(slope) - 1, -1, -1):
            own = after[step]
            factors[step].mul_(own[..., None, :])
            if step:
                earlier = after[step - 1].addcmul_(own, update[step])
                earlier.baddbmm_(factors[step].flatten(-2), back)
        by_product = factors.flatten(-2)
        by_gates = torch.cat([by_product[..., : 2 * hidden], after * by_new], dim=-1)
        if not any(ctx.needs_input_grad[1:]):
            return by_gates, None, None
        by_kernel = torch.bmm(
            states[:-1].permute(1, 3, 0, 2).flatten(2), by_product.transpose(0, 1).flatten(1, 2)
        )
        return by_gates, by_kernel, by_product.sum(dim=(0, 2))[:, None]
