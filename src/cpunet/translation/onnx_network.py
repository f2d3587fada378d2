"""The graph of a Positional U-Net, as torch exports it."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from cpunet.errors import CpunetError
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.pulses.container import FloatArray
from cpunet.translation.onnx_readout import OPSET


class NetworkGraph(PositionalUNet):
    """A Positional U-Net whose latent draw is an input."""

    def __init__(self, network: PositionalUNet) -> None:
        nn.Module.__init__(self)  # all attributes of the base are taken over
        self.__dict__.update(copy.deepcopy(network).cpu().eval().__dict__)
        # (channels, samples) of the draw
        self.latent = network.latent_mean.out_channels, network.length // 16

    def forward(self, windows: Tensor, epsilon: Tensor) -> Tensor:  # type: ignore[override]
        """Windows (batch, samples) and epsilon (batch, channels, samples / 16) → windows."""
        # the base passes its generator on to `_latent`; here this argument is the draw itself
        drawn = cast(torch.Generator, epsilon)
        return super().forward(windows[:, None], generator=drawn)[:, 0]

    def _latent(self, x: Tensor, generator: Any, mean: bool) -> Tensor:
        del mean
        centre: Tensor = self.latent_mean(x)
        return centre + torch.exp(0.5 * self.latent_log_variance(x)) * cast(Tensor, generator)

    def expected(self, given: Mapping[str, FloatArray]) -> npt.NDArray[np.float32]:
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
                program = torch.onnx.export(
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
        return cast(Any, program).model_proto
