"""The graph of a Positional U-Net, as torch exports it."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from cpunet.errors import CpunetError
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.pulses.container import FloatArray
from cpunet.translation.onnx_readout import OPSET


class _Graph(nn.Module):
    """A Positional U-Net whose latent draw is an input."""

    network: PositionalUNet

    def forward(self, windows: Tensor, epsilon: Tensor) -> Tensor:
        """Windows (batch, samples) and epsilon (batch, channels, samples / 16) → windows."""
        return self.network(windows[:, None], epsilon=epsilon)[:, 0]  # type: ignore[no-any-return]


def network_model(
    network: PositionalUNet, given: Mapping[str, FloatArray]
) -> tuple[Any, Callable[..., FloatArray]]:
    """The ONNX model of a network, of any batch size, and the network as a function of arrays.

    Parameters
    ----------
    network
        The network.
    given
        Windows and a draw, as an example.

    Raises
    ------
    CpunetError
        If ONNX lacks an operator.
    """
    graph = _Graph()
    graph.network = copy.deepcopy(network).cpu()
    graph.eval()

    def translated(*arrays: FloatArray) -> FloatArray:
        with torch.inference_mode():
            windows: FloatArray = graph(*map(torch.from_numpy, arrays)).numpy()
        return windows

    batch = torch.export.Dim("batch", min=1)
    example = tuple(map(torch.from_numpy, given.values()))
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
                output_names=["translated"],
                opset_version=OPSET,
                dynamo=True,
                verbose=False,
            )
    except torch.onnx.OnnxExporterError as error:
        raise CpunetError("ONNX has no operators for this run's U-Net") from error
    finally:
        logger.setLevel(level)
    return program.model_proto, translated
