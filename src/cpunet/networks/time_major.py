"""The Positional U-Net computed faster on CPUs, with the same weights and the same results.

Activations are stored time first, shape (samples, batch, channels).  Convolutions then need a
third to a fifth of the multiplications (`cpunet.networks.tiled_convolution`), batch norms and
1×1 convolutions act on plain matrices, and pooling, interpolation and concatenation move whole
rows.

Several batches can be run in one pass: each has its own batch statistics, as if it were run
alone, and the running averages are updated with one batch after the other.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Self, cast

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_weights

from cpunet.networks.positional_unet import SLOPE, PositionalMap, PositionalUNet
from cpunet.networks.tiled_convolution import (
    Tiling,
    convolve,
    convolve_spread,
    spread_kernel,
    tiling,
)

NARROWEST = 16  # width below which plain convolutions are as fast
BLOCK = 16  # pulses that a frozen network takes at once: larger blocks do not fit into caches


def fast_passes_pay(network: PositionalUNet, device: str) -> bool:
    """Whether these passes are faster on a device; on a GPU, cuDNN is."""
    return device == "cpu" and network.width >= NARROWEST


def translate(
    network: PositionalUNet, *batches: Tensor, generator: torch.Generator | None = None
) -> tuple[Tensor, ...]:
    """Translate batches with a network in training mode, in one pass.

    Parameters
    ----------
    network
        Its weights, modes and running statistics are used and updated as by its own
        ``forward``, called with one batch after the other.
    batches
        Each of shape (batch, 1, samples), all of one size.
    generator
        Source of the latent noise.

    Returns
    -------
    tuple of Tensor
        The translation of each, of the same shape.
    """
    groups = len(batches)
    # side by side: each group has its own channels in the batch norms
    pulses = torch.stack(batches, dim=1).flatten(0, 1)
    out = _Pass(network, groups, generator)(pulses)
    return out.view(-1, groups, *out.shape[1:]).unbind(dim=1)


class _Pass:
    """One pass of a network over `groups` batches."""

    mean = False  # whether to take the latent mean instead of a draw

    def __init__(
        self, network: PositionalUNet, groups: int, generator: torch.Generator | None
    ) -> None:
        self.network, self.groups, self.generator = network, groups, generator

    def __call__(self, pulses: Tensor) -> Tensor:
        net = self.network
        x = _mapped(net.maps_down[0], self._block(net.inlet, pulses.permute(2, 0, 1)))
        skips = [x]
        for block, position in zip(net.down[:3], net.maps_down[1:], strict=True):
            x = _mapped(position, self._block(block, _halved(x)))
            skips.append(x)
        x = self._latent(self._block(net.down[3], _halved(x)))
        x = _mapped(net.map_latent, x)
        for level, block in enumerate(net.up):
            x = self._block(block, _joined(skips[3 - level], x))
            if level < 3:
                x = _mapped(net.maps_up[level], x)
        out = _pointwise(net.outlet, x).permute(1, 2, 0)
        return cast(Tensor, net.skip(pulses)) + out if net.residual else out

    def _block(self, block: nn.Module, x: Tensor) -> Tensor:
        first, norm, _, second, second_norm, _ = cast(nn.Sequential, block)
        x = self._normalised(norm, _convolved(first, x))
        return self._normalised(second_norm, _convolved(second, x))

    def _normalised(self, norm: nn.Module, x: Tensor) -> Tensor:
        """Batch norm with the statistics of each group, and the rectifier."""
        assert isinstance(norm, nn.BatchNorm1d)
        length, batch, channels = x.shape
        if norm.training and self.groups > 1:
            flat = _by_group(norm, x.reshape(-1, self.groups * channels), self.groups)
        else:
            flat = norm(x.reshape(-1, channels))
        flat = functional.leaky_relu(flat, SLOPE, inplace=True)
        return flat.view(length, batch, channels)

    def _latent(self, x: Tensor) -> Tensor:
        centre = _pointwise(self.network.latent_mean, x)
        if self.mean:
            return centre
        spread = torch.exp(0.5 * _pointwise(self.network.latent_log_variance, x))
        # in the order of the network's own draws
        noise = torch.empty_like(centre.permute(1, 2, 0), memory_format=torch.contiguous_format)
        noise.normal_(generator=self.generator)
        return torch.addcmul(centre, spread, noise.permute(2, 0, 1))


class FrozenUNet(_Pass):
    """A trained network that will not change, for translation.

    Its batch norms are folded into the convolutions, whose kernels are prepared once.

    Parameters
    ----------
    network
        In evaluation mode, on a CPU.
    """

    def __init__(self, network: PositionalUNet) -> None:
        super().__init__(network, 1, None)
        self._prepared: dict[nn.Module, _Prepared] = {}

    def translate(
        self, pulses: Tensor, *, generator: torch.Generator | None = None, mean: bool = False
    ) -> Tensor:
        """Like the network's own ``forward``, with the same draws, but without gradients."""
        self.generator, self.mean = generator, mean
        with torch.no_grad():
            return torch.cat([self(block) for block in torch.split(pulses, BLOCK)])

    def _block(self, block: nn.Module, x: Tensor) -> Tensor:
        first, norm, _, second, second_norm, _ = cast(nn.Sequential, block)
        for convolution, own in ((first, norm), (second, second_norm)):
            prepared = self._prepared.get(convolution)
            if prepared is None:
                prepared = self._prepared[convolution] = _Prepared.of(convolution, own, len(x))
            x = functional.leaky_relu_(prepared(x), SLOPE)
        return x


class _Prepared(NamedTuple):
    """A convolution with the batch norm after it."""

    weight: Tensor
    bias: Tensor
    tiles: Tiling | None  # None: the weight is a plain kernel

    @classmethod
    def of(cls, convolution: nn.Module, norm: nn.Module, length: int) -> Self:
        assert isinstance(convolution, nn.Conv1d)
        assert isinstance(norm, nn.BatchNorm1d)
        assert norm.running_mean is not None
        assert norm.running_var is not None
        weight, bias = fuse_conv_bn_weights(
            convolution.weight,
            convolution.bias,
            norm.running_mean,
            norm.running_var,
            norm.eps,
            norm.weight,
            norm.bias,
        )
        out, inside, kernel = weight.shape
        if inside == 1:
            return cls(weight, bias, None)
        tiles = tiling(kernel, length, inside, out, weight.dtype)
        return cls(spread_kernel(weight, tiles), bias, tiles)

    def __call__(self, x: Tensor) -> Tensor:
        if self.tiles is None:
            out = functional.conv1d(x.permute(1, 2, 0), self.weight, self.bias, padding="same")
            return out.permute(2, 0, 1).contiguous()
        return convolve_spread(x, self.weight, self.tiles)[0].add_(self.bias)


def _by_group(norm: nn.BatchNorm1d, x: Tensor, groups: int) -> Tensor:
    """Batch norm of groups of channels, shape (rows, groups · channels), that share weights."""
    mean, variance = x.new_zeros(2, x.shape[1])
    out = functional.batch_norm(
        x,
        mean,
        variance,
        norm.weight.repeat(groups),
        norm.bias.repeat(groups),
        training=True,
        momentum=1.0,  # returns the statistics of this batch
        eps=norm.eps,
    )
    assert norm.momentum is not None
    assert norm.running_mean is not None
    assert norm.running_var is not None
    assert norm.num_batches_tracked is not None
    norm.num_batches_tracked += groups
    with torch.no_grad():
        for own_mean, own_variance in zip(
            mean.chunk(groups), variance.chunk(groups), strict=True
        ):
            norm.running_mean.lerp_(own_mean, norm.momentum)
            norm.running_var.lerp_(own_variance, norm.momentum)
    return out


def _convolved(convolution: nn.Module, x: Tensor) -> Tensor:
    assert isinstance(convolution, nn.Conv1d)
    weight = convolution.weight
    if weight.shape[1] > 1:
        return convolve(x, weight)
    out = functional.conv1d(x.permute(1, 2, 0), weight, padding="same")
    return out.permute(2, 0, 1).contiguous()


def _pointwise(convolution: nn.Module, x: Tensor) -> Tensor:
    """A convolution with a kernel of one sample."""
    assert isinstance(convolution, nn.Conv1d)
    return functional.linear(x, convolution.weight[:, :, 0], convolution.bias)


def _mapped(position: nn.Module, x: Tensor) -> Tensor:
    assert isinstance(position, PositionalMap)
    values = position.values.permute(2, 0, 1).contiguous()
    return cast(Tensor, position.dropout(x + values))


def _halved(x: Tensor) -> Tensor:
    """Maximum of each pair of samples."""
    return torch.maximum(x[0::2], x[1::2])


def _joined(skip: Tensor, x: Tensor) -> Tensor:
    """Concatenate a skip with `x`, interpolated to its length with the end samples aligned."""
    result: Tensor = _Joined.apply(skip, x)  # type: ignore[no-untyped-call]
    return result


class _Joined(torch.autograd.Function):
    """`interpolate(…, align_corners=True)` to twice the length and `cat`, in one."""

    @staticmethod
    def forward(ctx: Any, skip: Tensor, x: Tensor) -> Tensor:
        length, batch, channels = x.shape
        ctx.beside = beside = skip.shape[2]
        out = x.new_empty(2 * length, batch, beside + channels)
        out[:, :, :beside] = skip
        wide = out[:, :, beside:]
        before, after = _shares(x)
        wide[0], wide[-1] = x[0], x[-1]
        torch.lerp(x[1:], x[:-1], before, out=wide[2::2])
        torch.lerp(x[:-1], x[1:], after, out=wide[1:-1:2])
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, Tensor]:
        wide = slope[:, :, ctx.beside :]
        even, odd = wide[0::2], wide[1::2]
        before, after = _shares(even)
        by_x = even + odd
        by_x[:-1].addcmul_(even[1:], before).addcmul_(odd[:-1], after, value=-1)
        by_x[1:].addcmul_(odd[:-1], after).addcmul_(even[1:], before, value=-1)
        return slope[:, :, : ctx.beside], by_x


def _shares(x: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of the sample before in even new samples, and of the one after in odd ones."""
    length = len(x)
    share = torch.arange(1, length, dtype=x.dtype, device=x.device) / (2 * length - 1)
    return share[:, None, None], share.flip(0)[:, None, None]
