"""The deterministic part of a run as ONNX, for other tools.

Noise is not part of the graph: a network takes its latent draw as a second input, and the
electronic noise of a readout chain is added to its records.  The preparation is not part of
the graph either.
"""

from __future__ import annotations

import copy
import importlib
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from cpunet.errors import CpunetError
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_layer import DriftClock

# Version of the operators, and the lowest version of the file format that holds them: what a
# runtime older than the exporter reads.
OPSET, FORMAT = 18, 8
TOLERANCE = 1e-4  # maximum difference between file and run, for pulses of height 1
CHECKED = (1, 3)  # batch sizes of the comparison
TRACED = 2


class NetworkGraph(PositionalUNet):
    """A Positional U-Net whose latent draw is an input."""

    def __init__(self, network: PositionalUNet) -> None:
        nn.Module.__init__(self)  # all attributes of the base are taken over
        self.__dict__.update(copy.deepcopy(network).__dict__)

    def forward(self, windows: Tensor, epsilon: Tensor) -> Tensor:  # type: ignore[override]
        """Windows (batch, samples) and epsilon (batch, channels, samples / 16) → windows."""
        # the base passes its generator on to `_latent`; here this argument is the draw itself
        drawn = cast(torch.Generator, epsilon)
        return super().forward(windows[:, None], generator=drawn)[:, 0]

    def _latent(self, x: Tensor, generator: Any, mean: bool) -> Tensor:
        del mean
        centre: Tensor = self.latent_mean(x)
        return centre + torch.exp(0.5 * self.latent_log_variance(x)) * cast(Tensor, generator)


class ChainGraph(nn.Module):
    """A readout chain as a matrix, with a stretch of the drift if there is one.

    The chain is linear.  A product with its responses to single samples gives the same
    records as its Fourier transforms, which few formats support.
    """

    matrix: Tensor

    def __init__(self, chain: ResponseGenerator, length: int) -> None:
        super().__init__()
        linear = copy.deepcopy(chain.response)
        self.drift, linear.drift = linear.drift, None
        self.dt_ns = float(linear.dt_ns)
        with torch.inference_mode():
            matrix = linear(torch.eye(length, device=linear.dt_ns.device))
        self.register_buffer("matrix", matrix.clone().cpu())

    def forward(self, windows: Tensor) -> Tensor:
        """Windows (batch, samples) → noise-free records (batch, 200 + samples + 400)."""
        if isinstance(self.drift, DriftClock):
            windows = self.drift(windows, dt_ns=self.dt_ns)
        elif self.drift is not None:
            windows = self.drift(windows)
        return windows @ self.matrix


@dataclass(frozen=True)
class Graph:
    """A module to export, with the names of its inputs and output, and inputs for a check."""

    module: nn.Module
    inputs: tuple[str, ...]
    output: str
    example: Callable[[int], tuple[Tensor, ...]]
    expected: Callable[[tuple[Tensor, ...]], Tensor]


def example_windows(length: int) -> Callable[[int], Tensor]:
    """Prepared pulses with edges of several widths and positions."""

    def windows(n: int) -> Tensor:
        rng = np.random.default_rng(n)
        width, at = rng.uniform(2, 12, (n, 1)), length // 2 - rng.uniform(10, 60, (n, 1))
        charge = 1 / (1 + np.exp(-(np.arange(length) - at) / width))
        return torch.from_numpy(charge.astype(np.float32))

    return windows


def write_onnx(graph: Graph, path: Path) -> float:
    """Write a graph of any batch size, and compare the file's output with that of the run.

    Parameters
    ----------
    graph
        Result of `cpunet.translation.backends.Backend.graph`.
    path
        File to write.

    Returns
    -------
    float
        Largest difference of any sample.

    Raises
    ------
    CpunetError
        If a package is missing or the file differs from the run by more than 1e-4.
    """
    with torch.no_grad(), warnings.catch_warnings():
        # exporters warn of their own deprecations
        warnings.simplefilter("ignore")
        path.write_bytes(_program(graph))
        providers = ["CPUExecutionProvider"]
        session = _needed("onnxruntime").InferenceSession(str(path), providers=providers)
        worst = 0.0
        for n in CHECKED:
            given = graph.example(n)
            arrays = [values.numpy() for values in given]
            (found,) = session.run(None, dict(zip(graph.inputs, arrays, strict=True)))
            worst = max(worst, float(np.abs(found - graph.expected(given).numpy()).max()))
    if not worst <= TOLERANCE:
        raise CpunetError(f"{path}: the exported graph differs from the run by {worst:.1e}")
    return worst


def _program(graph: Graph) -> bytes:
    for package in ("onnx", "onnxscript"):
        _needed(package)
    batch = torch.export.Dim("batch", min=1)
    shapes = tuple({0: batch} for _ in graph.inputs)
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = logger.level
    logger.setLevel(logging.ERROR)  # it reports missing torchvision every time
    try:
        program = torch.onnx.export(
            torch.export.export(graph.module, graph.example(TRACED), dynamic_shapes=shapes),
            input_names=list(graph.inputs),
            output_names=[graph.output],
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    except torch.onnx.OnnxExporterError as error:
        raise CpunetError("ONNX has no operators for this run's U-Net") from error
    finally:
        logger.setLevel(level)
    model = cast(Any, program).model_proto
    model.ir_version = FORMAT
    _needed("onnx").checker.check_model(model)
    content: bytes = model.SerializeToString()
    return content


def _needed(package: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise CpunetError(
            f"the package {package} is needed for ONNX; pip install 'cpunet-hpge[onnx]'"
        ) from error
