"""Export the deterministic part of a run for other tools: ONNX, TorchScript or torch.export.

Noise is not part of the graph: a network takes its latent draw as a second input, and the
electronic noise of a readout chain is added to its records.  The preparation is not part of
the graph either.
"""

from __future__ import annotations

import importlib
import io
import logging
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt
import torch

from cpunet.errors import CpunetError
from cpunet.translation.graphs import Graph

Format = Literal["onnx", "torchscript", "torch-export"]
FORMATS: tuple[Format, ...] = ("onnx", "torchscript", "torch-export")
OPSET = 18
TOLERANCE = 1e-4  # maximum difference between file and run, for pulses of height 1
CHECKED = (1, 3)  # batch sizes of the comparison
TRACED = 2

Arrays = list[npt.NDArray[np.float32]]


def export(graph: Graph, path: Path, form: Format) -> float:
    """Write a graph and compare the output of the file with that of the run.

    Parameters
    ----------
    graph
        Result of `cpunet.translation.backends.Backend.graph`.
    path
        File to write.
    form
        Format: ``"onnx"`` (opset 18), ``"torchscript"`` or ``"torch-export"``, all with
        variable batch size.

    Returns
    -------
    float
        Largest difference of any sample.

    Raises
    ------
    CpunetError
        If a package is missing or the file differs from the run by more than 1e-4.
    """
    if form not in FORMATS:
        raise CpunetError(f"format {form!r} is not known; use {', '.join(FORMATS)}")
    write, read = {
        "onnx": (_write_onnx, _read_onnx),
        "torchscript": (_write_torchscript, _read_torchscript),
        "torch-export": (_write_export, _read_export),
    }[form]
    with torch.no_grad(), warnings.catch_warnings():
        # exporters warn of their own deprecations
        warnings.simplefilter("ignore")
        path.write_bytes(write(graph))
        run = read(path)
        worst = 0.0
        for n in CHECKED:
            given = graph.example(n)
            found = run(graph, [values.numpy() for values in given])
            worst = max(worst, float(np.abs(found - graph.expected(given).numpy()).max()))
    if not worst <= TOLERANCE:
        raise CpunetError(
            f"{path}: the exported graph differs from the run by {worst:.1e}; choose another "
            "format"
        )
    return worst


def _program(graph: Graph) -> torch.export.ExportedProgram:
    batch = torch.export.Dim("batch", min=1)
    shapes = tuple({0: batch} for _ in graph.inputs)
    return torch.export.export(graph.module, graph.example(TRACED), dynamic_shapes=shapes)


def _write_export(graph: Graph) -> bytes:
    stream = io.BytesIO()
    torch.export.save(_program(graph), stream)
    return stream.getvalue()


def _read_export(path: Path) -> Callable[[Graph, Arrays], npt.NDArray[np.float32]]:
    # read by content: torch would require a name that ends in .pt2
    module = torch.export.load(io.BytesIO(path.read_bytes())).module()
    return lambda _graph, given: module(*map(torch.from_numpy, given)).numpy()


def _write_torchscript(graph: Graph) -> bytes:
    stream = io.BytesIO()
    traced = cast(Any, torch.jit).trace(graph.module, graph.example(TRACED), check_trace=False)
    torch.jit.save(traced, stream)
    return stream.getvalue()


def _read_torchscript(path: Path) -> Callable[[Graph, Arrays], npt.NDArray[np.float32]]:
    module = cast(Any, torch.jit).load(str(path))
    return lambda _graph, given: module(*map(torch.from_numpy, given)).numpy()


def _write_onnx(graph: Graph) -> bytes:
    for package in ("onnx", "onnxscript"):
        _needed(package)
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = logger.level
    logger.setLevel(logging.ERROR)  # it reports missing torchvision every time
    try:
        program = torch.onnx.export(
            _program(graph),
            input_names=list(graph.inputs),
            output_names=[graph.output],
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    except torch.onnx.OnnxExporterError as error:
        raise CpunetError(
            "ONNX has no operators for this run's U-Net; give --format torchscript"
        ) from error
    finally:
        logger.setLevel(level)
    content: bytes = cast(Any, program).model_proto.SerializeToString()
    return content


def _read_onnx(path: Path) -> Callable[[Graph, Arrays], npt.NDArray[np.float32]]:
    onnxruntime = _needed("onnxruntime")
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])

    def run(graph: Graph, given: Arrays) -> npt.NDArray[np.float32]:
        (found,) = session.run(None, dict(zip(graph.inputs, given, strict=True)))
        return np.asarray(found)

    return run


def _needed(package: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise CpunetError(
            f"the package {package} is needed for ONNX; pip install 'cpunet-hpge[onnx]'"
        ) from error
