"""Export a run as ONNX: its graph for other software, and its noise.

Noise is not part of the graph: a network takes its latent draw as a second input, and the
electronic noise of a readout chain is added to its records.  The preparation is not part of
the graph either.

Graphs of a readout and of its inverse are made by ONNX alone, that of a network by torch.  A
readout is linear.  A product with its responses to single samples gives the same records as
its Fourier transforms, which few runtimes have.
"""

from __future__ import annotations

import copy
import importlib
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.networks.generators import MIN_LEVEL, LinearInverse, ResponseGenerator
from cpunet.networks.response_layer import END, LONGEST_US, MIN_STRETCH, ElectronicsResponse
from cpunet.outputs import refuse_existing, written_aside
from cpunet.progress import stage
from cpunet.pulses.container import FloatArray
from cpunet.training.run import RunLike, used_run
from cpunet.translation.translator import IREN, REN, Translator

OPSET = 18  # version of the operators
# Lowest version of the file format that holds the operators: what an older runtime reads.
FORMAT = 8
FLOAT, INT64, DOUBLE = 1, 7, 11  # types of ONNX
TOLERANCE = 1e-4  # maximum difference between file and run, for pulses of height 1
CHECKED = (1, 3)  # batch sizes of the comparison
# weights of four samples by powers of the time between the middle ones (Catmull-Rom)
CUBICS = np.array([[0, -1, 2, -1], [2, 0, -5, 3], [0, 1, 4, -3], [0, 0, -1, 1]], np.float32) / 2


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
    run: RunLike, out: str | Path, *, inverse: bool = False, force: bool = False
) -> Export:
    """Export the deterministic part of a run as ONNX, and check it against the run.

    If the run adds electronic noise, ``NAME.noise.npz`` next to ``NAME.onnx`` (or another name
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
    backend, length = kind.of(run).backend, run.recipe.preparation.length
    facts = {"recipe": run.recipe.name, "peak": run.peak, "seed": run.seed, "dt_ns": run.dt_ns}
    with stage("Exporting"), written_aside(out) as aside:
        checker = needed("onnx").checker
        model, latent, expected = graph_of(backend.network, length)
        model.ir_version = FORMAT
        for name, value in {"cpunet": cpunet.__version__, **facts}.items():
            model.metadata_props.add(key=name, value=str(value))
        checker.check_model(model)
        aside.write_bytes(model.SerializeToString())

        runtime = needed("onnxruntime")
        session = runtime.InferenceSession(str(aside), providers=["CPUExecutionProvider"])
        difference = 0.0
        for n in CHECKED:
            given = examples(n, length, latent)
            (output,) = session.run(None, given)
            wrong = np.abs(output - expected(*given.values()))
            difference = max(difference, float(wrong.max()))
        if not difference <= TOLERANCE:
            raise CpunetError(
                f"{out}: the exported graph differs from the run by {difference:.1e}"
            )
        if (noise := backend.noise) is not None:
            spectra: Any = {"continua": noise.kinds, "lines": noise.lines}
            spectra |= {"shares": noise.shares, "samples": noise.samples, "dt_ns": noise.dt_ns}
            with written_aside(noise_file) as stored, stored.open("wb") as stream:
                np.savez(stream, **spectra)
    if noise is None:
        noise_file.unlink(missing_ok=True)  # of an export that this one replaces
    return Export(out, None if noise is None else noise_file, difference)


def graph_of(
    network: Any, length: int
) -> tuple[Any, tuple[int, ...], Callable[..., FloatArray]]:
    """What can be exported of the network, chain or inverse of a run, for windows of a length.

    Inputs: prepared ``windows`` (batch, samples) and for a network ``epsilon``, either zeros
    for the latent mean or drawn from N(0, 1).  Output: ``translated`` windows of a network,
    unprepared ``records`` of a readout chain, ``pulses`` of its inverse.

    Returns
    -------
    model
        Of ONNX.
    latent
        Shape of a draw, empty without.
    expected
        What the run makes of inputs.

    Raises
    ------
    CpunetError
        If it has no graph.
    """
    behind = getattr(network, "linear", None) or getattr(network, "residual", None)
    if behind is not None:
        raise CpunetError(
            "ONNX graphs have a readout or a network, this run has both in series; export one "
            "of the recipe fast"
        )
    if isinstance(network, LinearInverse):
        return inverse_model(network), (), network
    if isinstance(network, ResponseGenerator):
        if network.response.by_height is not None:
            raise CpunetError(
                "the electronics of this run act by the height of a pulse, and a graph has no "
                "energies; train on one line alone for the linear part"
            )
        return chain_model(network.response, length), (), network
    needed("onnxscript")
    import torch

    latent = network.unet.latent_mean.out_channels, length // 16
    given = examples(2, length, latent)

    class WithDraw(torch.nn.Module):
        """The U-Net, whose latent draw is an input."""

        def __init__(self) -> None:
            super().__init__()
            self.unet = network.unet

        def forward(self, windows: torch.Tensor, epsilon: torch.Tensor) -> torch.Tensor:
            return self.unet(windows[:, None], epsilon=epsilon)[:, 0]  # type: ignore[no-any-return]

    graph = WithDraw().eval()

    def expected(*arrays: FloatArray) -> FloatArray:
        with torch.inference_mode():
            windows: FloatArray = graph(*map(torch.from_numpy, arrays)).numpy()
        return windows

    # which reports missing torchvision every time
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    example = tuple(map(torch.from_numpy, given.values()))
    any_batch = tuple({0: torch.export.Dim("batch", min=1)} for _ in given)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # exporters warn of their own deprecations
        program: Any = torch.onnx.export(
            torch.export.export(graph, example, dynamic_shapes=any_batch),
            input_names=list(given),
            output_names=["translated"],
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    return program.model_proto, latent, expected


def examples(n: int, length: int, latent: tuple[int, ...]) -> dict[str, FloatArray]:
    """Inputs of a graph: pulses with edges of several widths and positions, and a draw."""
    rng = np.random.default_rng(n)
    width, at = rng.uniform(2, 12, (n, 1)), length // 2 - rng.uniform(10, 60, (n, 1))
    charge = 1 / (1 + np.exp(-(np.arange(length) - at) / width))
    given = {"windows": charge.astype(np.float32)}
    if latent:
        given["epsilon"] = rng.normal(size=(n, *latent)).astype(np.float32)
    return given


def needed(package: str) -> Any:
    """A package of the extra ``onnx``.

    Raises
    ------
    CpunetError
        If it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise CpunetError(
            f"the package {package} is needed for ONNX; pip install 'cpunet-hpge[onnx]'"
        ) from error


@dataclass
class Graph:
    """A graph in the making, with ``windows`` (batch, samples) as input.

    Parameters
    ----------
    length
        Samples of a window.
    nodes, constants
        Objects of ONNX.
    """

    length: int
    nodes: list[Any] = field(default_factory=list)
    constants: list[Any] = field(default_factory=list)

    def __call__(self, operator: str, *inputs: Any, **attributes: Any) -> str:
        """Add a node, and return the name of its output.

        Parameters
        ----------
        operator, attributes
            See the operators of ONNX.
        inputs
            Names of outputs, and constants.
        """
        from onnx import helper, numpy_helper

        names, output = [*inputs], f"{operator}{len(self.nodes)}"
        for i, given in enumerate(inputs):
            if not isinstance(given, str):
                names[i] = f"constant{len(self.constants)}"
                self.constants.append(numpy_helper.from_array(np.asarray(given), names[i]))
        self.nodes.append(helper.make_node(operator, names, [output], **attributes))
        return output

    def model(self, output: str, name: str, samples: int) -> Any:
        """The model of which an output (batch, samples) is the result, under another name."""
        from onnx import helper

        self.nodes.append(helper.make_node("Identity", [output], [name]))
        windows = helper.make_tensor_value_info("windows", FLOAT, ["batch", self.length])
        made = helper.make_tensor_value_info(name, FLOAT, ["batch", samples])
        graph = helper.make_graph(self.nodes, "cpunet", [windows], [made], self.constants)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])


def chain_model(response: ElectronicsResponse, length: int) -> Any:
    """Windows (batch, samples) → noise-free records (batch, 200 + samples + 400).

    Parameters
    ----------
    response
        The readout.
    length
        Samples of a window.
    """
    linear = copy.copy(response)
    linear.drift = None
    matrix = linear(np.eye(length, dtype=np.float32))
    add, charge, last = Graph(length), "windows", length - 1
    if response.drift is not None:
        stretch, per_us = [*response.drift.stretch.tolist(), 0.0][:2]
        highest = add("ReduceMax", charge, [1], keepdims=1)
        risen = add("GreaterOrEqual", charge, add("Mul", np.float32(END), highest))
        end = add("ArgMax", add("Cast", risen, to=FLOAT), axis=1, keepdims=1)
        end = add("Cast", end, to=DOUBLE)
        before = add("Sub", end, np.arange(length, dtype=float))
        us = add("Clip", add("Mul", before, 1e-3 * float(response.dt_ns)), 0.0, LONGEST_US)
        factor = add("Max", add("Add", add("Mul", us, per_us), 1 + stretch), MIN_STRETCH)
        time = add("Sub", end, add("Div", before, factor))
        first = add("Clip", add("Floor", time), 0.0, float(last))
        part = add("Cast", add("Clip", add("Sub", time, first), 0.0, 1.0), to=FLOAT)
        sample = add("Cast", first, to=INT64)
        terms = []
        for step, (*lower, weight) in zip((-1, 0, 1, 2), CUBICS, strict=True):
            for value in reversed(lower):
                weight = add("Add", add("Mul", part, weight), value)
            place = add("Clip", add("Add", sample, step), 0, last)
            near = add("GatherElements", charge, place, axis=1)
            terms.append(add("Mul", weight, near))
        charge = add("Sum", *terms)
    return add.model(add("MatMul", charge, matrix), "records", matrix.shape[1])


def inverse_model(inverse: LinearInverse) -> Any:
    """Measured windows (batch, samples) → pulses within 0 … 1, as `LinearInverse`."""
    length = inverse.length
    add, index = Graph(length), np.arange(length)
    highest = add("ArgMax", "windows", axis=1, keepdims=1)
    low = add("Less", "windows", inverse.half_height.astype(np.float32))
    below = add("Cast", add("And", low, add("Less", index, highest)), to=INT64)
    after = add("ReduceMax", add("Mul", below, index + 1), [1], keepdims=1)
    sample = add("Max", add("Sub", after, 1), 0)
    double = add("Cast", "windows", to=DOUBLE)
    base, level, values = (
        add(
            "GatherElements",
            double,
            add("Clip", add("Add", sample, np.arange(first, stop)), 0, length - 1),
            axis=1,
        )
        for first, stop in (inverse.baseline, inverse.level, (-inverse.before, inverse.after))
    )
    base, level = (add("ReduceMean", part, [1], keepdims=1) for part in (base, level))
    height = add("Max", add("Sub", level, base), MIN_LEVEL)
    centred = add("Sub", add("Div", add("Sub", values, base), height), inverse.mean_in)
    product = add("MatMul", centred, inverse.weights.T.copy())
    charge = add("Clip", add("Add", product, inverse.mean_out), 0.0, 1.0)
    # 0 before the region and 1 after it
    padded = add("Pad", add("Pad", charge, [0, 1, 0, 0], 0.0), [0, 0, 0, 1], 1.0)
    shifted = add("Sub", index + 1 + inverse.before, sample)
    place = add("Clip", shifted, 0, len(inverse.mean_in) + 1)
    moved = add("GatherElements", padded, place, axis=1)
    return add.model(add("Cast", moved, to=FLOAT), "pulses", length)
