"""The deterministic part of a run as ONNX, for other tools.

Noise is not part of the graph: a network takes its latent draw as a second input, and the
electronic noise of a readout chain is added to its records.  The preparation is not part of
the graph either.
"""

from __future__ import annotations

import importlib
import logging
import warnings
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from cpunet.errors import CpunetError
from cpunet.translation.graphs import Graph

# Version of the operators, and the lowest version of the file format that holds them: what a
# runtime older than the exporter reads.
OPSET, FORMAT = 18, 8
TOLERANCE = 1e-4  # maximum difference between file and run, for pulses of height 1
CHECKED = (1, 3)  # batch sizes of the comparison
TRACED = 2


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
