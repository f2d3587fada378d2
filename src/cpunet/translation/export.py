"""Export a run as ONNX: its graph for other software, and its noise.

Noise is not part of the graph: a network takes its latent draw as a second input, and the
electronic noise of a readout chain is added to its records.  The preparation is not part of
the graph either.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.networks.generators import LinearInverse, ResponseGenerator
from cpunet.outputs import refuse_existing, written_aside
from cpunet.progress import stage
from cpunet.pulses.container import FloatArray
from cpunet.training.run import RunLike, used_run
from cpunet.translation.onnx_readout import chain_model, inverse_model
from cpunet.translation.translator import IREN, REN, Translator

# Lowest version of the file format that holds the operators: what an older runtime reads.
FORMAT = 8
TOLERANCE = 1e-4  # maximum difference between file and run, for pulses of height 1
CHECKED = (1, 3)  # batch sizes of the comparison


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
    from cpunet.translation.onnx_network import network_model

    latent = network.unet.latent_mean.out_channels, length // 16
    model, expected = network_model(network.unet, examples(2, length, latent))
    return model, latent, expected


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
