"""Batch norms over the pulses of all processes of a group.

torch's own run on GPUs only and have no second derivative, which a gradient penalty needs.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from cpunet.training.process_group import ProcessGroup


class GroupBatchNorm(nn.BatchNorm1d):
    """Replaces a batch norm with the same weights, and takes its statistics over the group.

    All processes must pass the same number of pulses.

    Parameters
    ----------
    norm
        The batch norm, with weights and running statistics; its tensors are reused.
    group
        Process group.
    """

    def __init__(self, norm: nn.BatchNorm1d, group: ProcessGroup) -> None:
        super().__init__(norm.num_features, norm.eps, norm.momentum)
        self.weight, self.bias = norm.weight, norm.bias
        self.running_mean, self.running_var = norm.running_mean, norm.running_var
        self.num_batches_tracked = norm.num_batches_tracked
        self.train(norm.training)
        self.group = group
        # communication is not compiled; disabled here, since importing the compiler is slow
        self._of_all = torch.compiler.disable(_of_all)  # type: ignore[no-untyped-call]

    def forward(self, x: Tensor) -> Tensor:
        """Normalise pulses, shape (batch, channels) or (batch, channels, samples)."""
        if not self.training:
            return super().forward(x)
        values = x.float() if x.dtype in (torch.bfloat16, torch.float16) else x
        axes = [axis for axis in range(x.ndim) if axis != 1]
        variance, mean = torch.var_mean(values, dim=axes, correction=0)
        means, variances = self._of_all(torch.stack([mean, variance]), self.group).unbind(1)
        # the group's variance: that within the processes, and that between them
        mean, variance = (
            means.mean(dim=0),
            variances.mean(dim=0) + means.var(dim=0, correction=0),
        )
        self._remember(mean.detach(), variance.detach(), x.numel() // x.shape[1])
        scale = self.weight * torch.rsqrt(variance + self.eps)
        shift = self.bias - mean * scale
        if x.ndim == 3:
            scale, shift = scale[:, None], shift[:, None]
        return torch.addcmul(shift, values, scale).to(x.dtype)  # keeps no other copy of x

    def _remember(self, mean: Tensor, variance: Tensor, count: int) -> None:
        """Update the running statistics, as `torch.nn.BatchNorm1d` does."""
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        count *= self.group.size
        with torch.no_grad():
            self.num_batches_tracked.add_(1)
            part = self.momentum
            if part is None:  # a plain average
                part = 1 / float(self.num_batches_tracked)
            self.running_mean.lerp_(mean.to(self.running_mean.dtype), part)
            unbiased = variance * (count / (count - 1))
            self.running_var.lerp_(unbiased.to(self.running_var.dtype), part)


def share_norms(network: nn.Module, group: ProcessGroup) -> None:
    """Let all batch norms of a network take their statistics over the group."""
    if group.size == 1:
        return
    for module in [*network.modules()]:
        for name, child in module.named_children():
            if type(child) is nn.BatchNorm1d:
                setattr(module, name, GroupBatchNorm(child, group))


def _of_all(own: Tensor, group: ProcessGroup) -> Tensor:
    """Stack the statistics of all processes, each of the same shape; differentiable."""
    rows = (group.rank, group.size - 1 - group.rank)
    return _GroupSum.apply(pad(own[None], (0, 0) * own.ndim + rows), group)  # type: ignore[no-any-return, no-untyped-call]


class _GroupSum(torch.autograd.Function):
    """Sum over the group; its first and second derivatives are sums over the group, too."""

    @staticmethod
    def forward(ctx: Any, own: Tensor, group: ProcessGroup) -> Tensor:
        ctx.group = group
        total = own.clone()
        group.add(total)
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return _GroupSum.apply(gradient.contiguous(), ctx.group), None  # type: ignore[no-untyped-call]
