"""One-dimensional convolutions with a third to a fifth of the multiplications.

A stretch of `samples` outputs of a convolution is a short circular convolution, which is a
product of discrete Fourier transforms.  All three steps are products with small constant
matrices, so that a whole layer runs as matrix products:

``output = inverse @ (spread(kernel) * forward(input))``

with one product of (pulses, channels in) by (channels in, channels out) for each of the
``products`` terms.  A complex product is done with three real ones (Karatsuba).  In exact
arithmetic the result is that of `torch.nn.functional.conv1d`; in float32 it differs by
rounding, by about 1e-6 of the largest value.

Activations are stored time first, shape (samples, batch, channels): a stretch of time is then a
contiguous matrix in memory, and nothing has to be copied.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

SHORTEST, LONGEST = 8, 64  # range of the length of a stretch in samples


class Tiling(NamedTuple):
    """A fast convolution of a stretch, as three matrices.

    Parameters
    ----------
    kernel
        (products, kernel length): kernel → factors.
    forward
        (products, samples + kernel length - 1): input → factors.
    inverse
        (samples, products): products → output.
    """

    kernel: Tensor
    forward: Tensor
    inverse: Tensor

    @property
    def samples(self) -> int:
        """Number of outputs of a stretch."""
        return len(self.inverse)


@lru_cache(maxsize=256)
def tiling(
    kernel: int, length: int, channels_in: int, channels_out: int, dtype: torch.dtype
) -> Tiling:
    """Tiling with the fewest multiplications for a layer of these sizes."""
    samples = min(
        range(SHORTEST, max(SHORTEST, min(LONGEST, length)) + 1),
        key=lambda m: _cost(m, kernel, length, channels_in, channels_out),
    )
    return _tiling(kernel, samples, dtype)


def _cost(samples: int, kernel: int, length: int, channels_in: int, channels_out: int) -> float:
    size = samples + kernel - 1
    products = _products(size)
    each = channels_in * channels_out + size * channels_in + samples * channels_out
    return -(-length // samples) * products * each


def _products(size: int) -> int:
    """Real multiplications of two transforms of `size` samples."""
    return (1 if size % 2 else 2) + 3 * ((size - 1) // 2)


@lru_cache(maxsize=64)
def _tiling(kernel: int, samples: int, dtype: torch.dtype) -> Tiling:
    size = samples + kernel - 1
    time = np.arange(size)
    spread: list[npt.NDArray[np.float64]] = []
    forward: list[npt.NDArray[np.float64]] = []
    inverse: list[npt.NDArray[np.float64]] = []
    for frequency in range(size // 2 + 1):
        phase = 2 * np.pi * frequency * time / size
        cosine, sine = np.cos(phase), np.sin(phase)
        if frequency in (0, size / 2):  # real
            spread.append(cosine)
            forward.append(cosine)
            inverse.append(cosine / size)
            continue
        # input a + ib times kernel c + id: c (a + b), a (d - c) and b (c + d)
        spread += [cosine, sine - cosine, cosine + sine]
        forward += [cosine - sine, cosine, -sine]
        inverse += [2 * v / size for v in (cosine - sine, -sine, -cosine)]

    def tensor(rows: list[npt.NDArray[np.float64]], length: int) -> Tensor:
        return torch.from_numpy(np.array(rows)[:, :length]).to(dtype).contiguous()

    return Tiling(
        tensor(spread, kernel), tensor(forward, size), tensor(inverse, samples).T.contiguous()
    )


def convolve(x: Tensor, weight: Tensor) -> Tensor:
    """Convolve without changing the length, as ``conv1d(…, padding="same")``.

    Parameters
    ----------
    x
        Shape (samples, batch, channels in).
    weight
        Shape (channels out, channels in, kernel), the kernel's length odd.

    Returns
    -------
    Tensor
        Shape (samples, batch, channels out).
    """
    result: Tensor = _Convolution.apply(x, weight)  # type: ignore[no-untyped-call]
    return result


def spread_kernel(weight: Tensor, tiles: Tiling) -> Tensor:
    """Factors of a kernel (out, in, kernel), shape (products, in, out)."""
    flat = weight.permute(2, 1, 0).reshape(weight.shape[2], -1)
    return (tiles.kernel @ flat).view(-1, weight.shape[1], weight.shape[0])


def convolve_spread(x: Tensor, factors: Tensor, tiles: Tiling) -> tuple[Tensor, Tensor]:
    """Convolve with a kernel's factors; return the result and the input's factors."""
    length, batch, _ = x.shape
    spread = _spread_input(x, tiles)
    products = torch.bmm(spread.flatten(1, 2), factors)
    count, channels = spread.shape[1], factors.shape[2]
    out = x.new_empty(count * tiles.samples, batch * channels)
    each = products.view(len(products), count, batch * channels)
    for tile, stretch in enumerate(torch.split(out, tiles.samples)):
        torch.mm(tiles.inverse, each[:, tile], out=stretch)
    return out[:length].view(length, batch, channels), spread


def _spread_input(x: Tensor, tiles: Tiling) -> Tensor:
    """Factors of the input, shape (products, tiles, batch, channels)."""
    length, batch, channels = x.shape
    products, size = tiles.forward.shape
    count = -(-length // tiles.samples)
    overlap = size - tiles.samples
    padded = x.new_zeros(count * tiles.samples + overlap, batch * channels)
    padded[overlap // 2 : overlap // 2 + length] = x.reshape(length, -1)
    spread = x.new_empty(products, count, batch * channels)
    for tile in range(count):
        first = tile * tiles.samples
        torch.mm(tiles.forward, padded[first : first + size], out=spread[:, tile])
    return spread.view(products, count, batch, channels)


class _Convolution(torch.autograd.Function):
    """The convolution, and the adjoint of each of its steps."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        channels_out, channels_in, kernel = weight.shape
        tiles = tiling(kernel, len(x), channels_in, channels_out, x.dtype)
        factors = spread_kernel(weight, tiles)
        out, spread = convolve_spread(x, factors, tiles)
        ctx.tiles, ctx.length = tiles, len(x)
        ctx.save_for_backward(spread, factors)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, Tensor | None]:
        tiles: Tiling = ctx.tiles
        spread, factors = ctx.saved_tensors
        products, count, batch, channels_in = spread.shape
        channels_out = factors.shape[2]
        by_product = slope.new_empty(products, count, batch * channels_out)
        padded = slope.new_zeros(count * tiles.samples, batch * channels_out)
        padded[: ctx.length] = slope.reshape(ctx.length, -1)
        for tile, stretch in enumerate(torch.split(padded, tiles.samples)):
            torch.mm(tiles.inverse.T, stretch, out=by_product[:, tile])
        by_row = by_product.view(products, count * batch, channels_out)
        by_weight = by_input = None
        if ctx.needs_input_grad[1]:
            by_factor = torch.bmm(spread.flatten(1, 2).transpose(1, 2), by_row)
            flat = tiles.kernel.T @ by_factor.view(products, -1)
            by_weight = flat.view(-1, channels_in, channels_out).permute(2, 1, 0)
        if ctx.needs_input_grad[0]:
            by_spread = torch.bmm(by_row, factors.transpose(1, 2))
            by_input = _gathered(by_spread.view(products, count, -1), tiles, ctx.length)
            by_input = by_input.view(ctx.length, batch, channels_in)
        return by_input, by_weight


def _gathered(by_spread: Tensor, tiles: Tiling, length: int) -> Tensor:
    """The adjoint of `_spread_input`: overlapping stretches are added."""
    size = tiles.forward.shape[1]
    overlap = size - tiles.samples
    count = by_spread.shape[1]
    padded = by_spread.new_zeros(count * tiles.samples + overlap, by_spread.shape[2])
    for tile in range(count):
        first = tile * tiles.samples
        padded[first : first + size].addmm_(tiles.forward.T, by_spread[:, tile])
    return padded[overlap // 2 : overlap // 2 + length]
