"""What a run computes without its noise, written in torch, and exported by it as ONNX.

A readout is linear.  A product with its responses to single samples gives the same records as
its Fourier transforms, which few runtimes have.
"""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cpunet.errors import CpunetError
from cpunet.networks.generators import MIN_LEVEL, LinearInverse
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_layer import END, LONGEST_US, MIN_STRETCH, ElectronicsResponse
from cpunet.pulses.container import FloatArray

OPSET = 18  # version of the operators


class ReadoutGraph(nn.Module):
    """Windows (batch, samples) → noise-free records (batch, 200 + samples + 400)."""

    def __init__(self, response: ElectronicsResponse, length: int) -> None:
        super().__init__()
        linear = copy.copy(response)
        linear.drift = None
        self.matrix = torch.from_numpy(linear(np.eye(length, dtype=np.float32)))
        self.stretch = [] if response.drift is None else response.drift.stretch.tolist()
        self.dt_us = 1e-3 * float(response.dt_ns)

    def forward(self, windows: Tensor) -> Tensor:
        """As `ElectronicsResponse`, with the drift of `DriftClock`."""
        if self.stretch:
            last = windows.shape[1] - 1
            risen = windows >= END * windows.amax(1, keepdim=True)
            end = risen.int().argmax(1, keepdim=True)
            before = end - torch.arange(last + 1, dtype=torch.float64)
            us = (self.dt_us * before).clamp(0, LONGEST_US)
            factor = torch.ones_like(us)
            for i, term in enumerate(self.stretch):
                factor = factor + term * us**i
            times = end - before / factor.clamp(min=MIN_STRETCH)
            first = times.floor().clamp(0, last)
            part = (times - first).clamp(0, 1).float()
            near = [windows.gather(1, (first.long() + i).clamp(0, last)) for i in (-1, 0, 1, 2)]
            a, b, c, d = near  # cubics through four samples (Catmull-Rom)
            rise, bend = 0.5 * (c - a), a - 2.5 * b + 2 * c - 0.5 * d
            skew = 0.5 * (d - a) + 1.5 * (b - c)
            windows = b + part * (rise + part * (bend + part * skew))
        return windows @ self.matrix


class InverseGraph(nn.Module):
    """Measured windows (batch, samples) → pulses within 0 … 1, as `LinearInverse`."""

    def __init__(self, inverse: LinearInverse) -> None:
        super().__init__()
        self.inverse = inverse
        self.mean_in, self.mean_out, self.weights = (
            torch.from_numpy(array)
            for array in (inverse.mean_in, inverse.mean_out, inverse.weights)
        )

    def forward(self, windows: Tensor) -> Tensor:
        of, length = self.inverse, self.inverse.length
        index = torch.arange(length)
        below = (windows < float(of.half_height)) & (index < windows.argmax(1, keepdim=True))
        sample = ((below * (index + 1)).amax(1, keepdim=True) - 1).clamp(min=0)
        base, top, region = (
            windows.double().gather(1, (sample + torch.arange(*part)).clamp(0, length - 1))
            for part in (of.baseline, of.level, (-of.before, of.after))
        )
        base = base.mean(1, keepdim=True)
        height = (top.mean(1, keepdim=True) - base).clamp(min=MIN_LEVEL)
        scaled = (region - base) / height - self.mean_in
        charge = (self.mean_out + scaled @ self.weights.T).clamp(0, 1)
        # 0 before the region and 1 after it
        padded = nn.functional.pad(nn.functional.pad(charge, (1, 0)), (0, 1), value=1.0)
        place = (index + 1 + of.before - sample).clamp(0, padded.shape[1] - 1)
        return padded.gather(1, place).float()


class NetworkGraph(nn.Module):
    """A Positional U-Net whose latent draw is an input."""

    def __init__(self, network: PositionalUNet) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).cpu().eval()

    def forward(self, windows: Tensor, epsilon: Tensor) -> Tensor:
        """Windows (batch, samples) and epsilon (batch, channels, samples / 16) → windows."""
        return self.network(windows[:, None], epsilon=epsilon)[:, 0]  # type: ignore[no-any-return]


def onnx_model(graph: nn.Module, given: Mapping[str, FloatArray], output: str) -> Any:
    """The ONNX model of a graph, of any batch size.

    Parameters
    ----------
    graph
        What is exported.
    given
        Inputs by name, as an example.
    output
        Name of the output.

    Raises
    ------
    CpunetError
        If ONNX lacks an operator.
    """
    batch = torch.export.Dim("batch", min=1)
    example = tuple(torch.from_numpy(values) for values in given.values())
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = logger.level
    logger.setLevel(logging.ERROR)  # it reports missing torchvision every time
    try:
        with torch.no_grad(), warnings.catch_warnings():
            # exporters warn of their own deprecations
            warnings.simplefilter("ignore")
            shapes = tuple({0: batch} for _ in given)
            program: Any = torch.onnx.export(
                torch.export.export(graph, example, dynamic_shapes=shapes),
                input_names=list(given),
                output_names=[output],
                opset_version=OPSET,
                dynamo=True,
                verbose=False,
            )
    except torch.onnx.OnnxExporterError as error:
        raise CpunetError("ONNX has no operators for this run") from error
    finally:
        logger.setLevel(level)
    return program.model_proto
