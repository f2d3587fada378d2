"""Export a run as ONNX: its graph for other software, and its noise.

Noise is not part of the graph: a network takes its latent draw as a second input, and the
electronic noise of a readout chain is added to its records.  The preparation is not part of
the graph either.
"""

from __future__ import annotations

import copy
import importlib
import logging
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

import cpunet
from cpunet.errors import CpunetError
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_layer import DriftClock
from cpunet.outputs import refuse_existing, written_aside
from cpunet.progress import stage
from cpunet.training.run import RunLike, used_run
from cpunet.translation.translator import IREN, REN, Translator

# Version of the operators, and the lowest version of the file format that holds them: what a
# runtime older than the exporter reads.
OPSET, FORMAT = 18, 8
TOLERANCE = 1e-4  # maximum difference between file and run, for pulses of height 1
CHECKED = (1, 3)  # batch sizes of the comparison
TRACED = 2


@dataclass(frozen=True)
class Export:
    """Exported files, and the largest difference of a sample from the run."""

    graph: Path
    noise: Path | None
    difference: float

    def __str__(self) -> str:
        files = f"{self.graph}, {self.noise}" if self.noise else self.graph
        return f"{files}: within {self.difference:.1e} of the run"


def export_onnx(
    run: RunLike,
    out: str | Path,
    *,
    inverse: bool = False,
    force: bool = False,
) -> Export:
    """Export the deterministic part of a run as ONNX, and check it against the run.

    If the run adds electronic noise, ``NAME.noise.npz`` beside ``NAME.onnx`` (or another name
    of `out`) contains its spectrum.  Recipe, line, seed and sampling period are metadata of the
    graph.

    Parameters
    ----------
    run
        A trained run or its folder.
    out
        File to write.
    inverse
        Export IREN instead of REN.
    force
        Replace existing files; that of noise is removed if there is none.

    Returns
    -------
    Export
        The files.

    Raises
    ------
    CpunetError
        If the run is not finished, a package is missing or the exported graph differs from the
        run.

    Examples
    --------
    cpunet export onnx run --out ren.onnx
    """
    out = Path(out)
    noise_file, run = out.with_suffix(".noise.npz"), used_run(run)
    for path in (out, noise_file):
        refuse_existing(path, run.folder, force=force)
    kind: type[Translator] = IREN if inverse else REN
    translator = kind.of(run)
    noise = translator.backend.noise
    graph = graph_of(translator.backend.network, run.recipe.preparation.length)
    told = {"recipe": run.recipe.name, "peak": run.peak, "seed": run.seed, "dt_ns": run.dt_ns}
    with stage("Exporting"), written_aside(out) as aside:
        difference = write_onnx(graph, aside, {"cpunet": cpunet.__version__, **told})
        if noise is not None:
            spectra: Any = {"continua": noise.kinds, "lines": noise.lines}
            spectra |= {"shares": noise.shares, "samples": noise.samples, "dt_ns": noise.dt_ns}
            with written_aside(noise_file) as stored, stored.open("wb") as stream:
                np.savez(stream, **spectra)
    if noise is None:
        noise_file.unlink(missing_ok=True)  # of an export that this one replaces
    return Export(out, None if noise is None else noise_file, difference)


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


def example_windows(length: int, n: int) -> Tensor:
    """Prepared pulses with edges of several widths and positions."""
    rng = np.random.default_rng(n)
    width, at = rng.uniform(2, 12, (n, 1)), length // 2 - rng.uniform(10, 60, (n, 1))
    charge = 1 / (1 + np.exp(-(np.arange(length) - at) / width))
    return torch.from_numpy(charge.astype(np.float32))


def graph_of(network: nn.Module, length: int) -> Graph:
    """What can be exported of the network, chain or inverse of a run, for windows of a length.

    Inputs: prepared ``windows`` (batch, samples) and for a network ``epsilon``, either zeros
    for the latent mean or drawn from N(0, 1).  Output: ``translated`` windows of a network,
    unprepared ``records`` of a readout chain, ``pulses`` of its inverse.
    """
    windows, network = partial(example_windows, length), network.cpu()
    if isinstance(network, PositionalUNet):
        shape = (network.latent_mean.out_channels, length // 16)

        def with_epsilon(n: int) -> tuple[Tensor, ...]:
            return windows(n), torch.randn(n, *shape, generator=_seeded(n))

        # the draw of a batch is that of its generator
        return Graph(
            NetworkGraph(network).eval(),
            ("windows", "epsilon"),
            "translated",
            with_epsilon,
            lambda given: network(given[0][:, None], generator=_seeded(len(given[0])))[:, 0],
        )
    module, output = network, "pulses"
    if isinstance(network, ResponseGenerator):
        module, output = ChainGraph(network, length).eval(), "records"
    return Graph(module, ("windows",), output, lambda n: (windows(n),), lambda g: network(*g))


def _seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def write_onnx(graph: Graph, path: Path, told: Mapping[str, object] = {}) -> float:
    """Write a graph of any batch size, and compare the file's output with that of the run.

    Parameters
    ----------
    graph
        Result of `graph_of`.
    path
        File to write.
    told
        Metadata of the file.

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
        path.write_bytes(_program(graph, told))
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


def _program(graph: Graph, told: Mapping[str, object]) -> bytes:
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
    for name, value in told.items():
        model.metadata_props.add(key=name, value=str(value))
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
