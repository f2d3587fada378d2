"""Export the deterministic part of a run for other tools: ONNX, TorchScript or torch.export.

Noise is not part of the graph: a network takes its latent draw as a second input, and the
electronic noise of a readout chain is added to its records.  The preparation is not part of
the graph either.
"""

from __future__ import annotations

import copy
import importlib
import io
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from cpunet.errors import CpunetError
from cpunet.networks.drift_clock import DriftClock
from cpunet.networks.linear_inverse import LinearInverse
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.translation.backends import NetworkBackend, ResponseBackend
from cpunet.translation.translator import Translator

Format = Literal["onnx", "torchscript", "torch-export"]
FORMATS: tuple[Format, ...] = ("onnx", "torchscript", "torch-export")
OPSET = 18
TOLERANCE = 1e-4  # maximum difference between file and run, for pulses of height 1
CHECKED = (1, 3)  # batch sizes of the comparison
TRACED = 2

Arrays = list[npt.NDArray[np.float32]]


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


def graph_of(translator: Translator) -> Graph:
    """The part of a translator that can be exported.

    Returns
    -------
    Graph
        Inputs: prepared ``windows`` (batch, samples) and for a network ``epsilon``, either
        zeros for the latent mean or drawn from N(0, 1).  Output: ``translated`` windows of a
        network, unprepared ``records`` of a readout chain, ``pulses`` of its inverse.
    """
    length = translator.recipe.preparation.length
    windows = _windows(length)
    backend = translator.backend
    if isinstance(backend, NetworkBackend):
        network = cast(PositionalUNet, backend.network)
        shape = (network.latent_mean.out_channels, length // 16)

        def with_epsilon(n: int) -> tuple[Tensor, ...]:
            draw = torch.Generator().manual_seed(n)
            return windows(n), torch.randn(n, *shape, generator=draw)

        module = NetworkGraph(network).cpu().eval()
        # the draw of a batch is that of its generator
        return Graph(
            module,
            ("windows", "epsilon"),
            "translated",
            with_epsilon,
            lambda given: network.cpu()(
                given[0][:, None], generator=torch.Generator().manual_seed(len(given[0]))
            )[:, 0],
        )
    if isinstance(backend, ResponseBackend):
        chain = backend.chain.cpu()
        return Graph(
            ChainGraph(chain, length).eval(),
            ("windows",),
            "records",
            lambda n: (windows(n),),
            lambda given: chain(given[0]),
        )
    inverse = cast(LinearInverse, backend.network).cpu()
    return Graph(
        inverse, ("windows",), "pulses", lambda n: (windows(n),), lambda g: inverse(*g)
    )


def export(graph: Graph, path: Path, form: Format) -> float:
    """Write a graph and compare the output of the file with that of the run.

    Parameters
    ----------
    graph
        Result of `graph_of`.
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


def _windows(length: int) -> Callable[[int], Tensor]:
    """Prepared pulses with edges of several widths and positions."""

    def windows(n: int) -> Tensor:
        rng = np.random.default_rng(n)
        width, at = rng.uniform(2, 12, (n, 1)), length // 2 - rng.uniform(10, 60, (n, 1))
        charge = 1 / (1 + np.exp(-(np.arange(length) - at) / width))
        return torch.from_numpy(charge.astype(np.float32))

    return windows


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
