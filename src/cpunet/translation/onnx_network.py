"""The graph of a Positional U-Net, as torch exports it."""

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
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.pulses.container import FloatArray
from cpunet.translation.onnx_readout import OPSET


class NetworkGraph(nn.Module):
    """A Positional U-Net whose latent draw is an input."""

    def __init__(self, network: PositionalUNet) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).cpu().eval()
        # (channels, samples) of the draw
        self.latent = network.latent_mean.out_channels, network.length // 16

    def forward(self, windows: Tensor, epsilon: Tensor) -> Tensor:
        """Windows (batch, samples) and epsilon (batch, channels, samples / 16) → windows."""
        return self.network(windows[:, None], epsilon=epsilon)[:, 0]  # type: ignore[no-any-return]

    def expected(self, given: Mapping[str, FloatArray]) -> FloatArray:
        """What the network makes of windows and draw."""
        with torch.inference_mode():
            translated = self(*(torch.from_numpy(values) for values in given.values()))
        return np.asarray(translated.numpy())

    def model(self, given: Mapping[str, FloatArray]) -> Any:
        """The ONNX model, of any batch size.

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
                    torch.export.export(self, example, dynamic_shapes=shapes),
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
        return program.model_proto
