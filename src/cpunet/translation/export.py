"""Export a run: its graph for other software, its noise, and a card that describes them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.networks.response_layer import PADDING_AFTER, PADDING_BEFORE
from cpunet.outputs import refuse_existing, written_aside
from cpunet.progress import stage
from cpunet.training.chain_description import describe_chain
from cpunet.training.run import Run, RunLike, as_run
from cpunet.translation.onnx import CHECKED, FORMAT, OPSET, TOLERANCE, Graph, write_onnx
from cpunet.translation.translator import IREN, REN, Translator


@dataclass(frozen=True)
class Export:
    """Exported files, and the largest difference of a sample from the run."""

    graph: Path
    card: Path
    noise: Path | None
    difference: float

    def __str__(self) -> str:
        files = [self.graph, self.card, *([self.noise] if self.noise else [])]
        return f"{', '.join(map(str, files))}: within {self.difference:.1e} of the run"


def export_onnx(
    run: RunLike,
    out: str | Path,
    *,
    inverse: bool = False,
    force: bool = False,
) -> Export:
    """Export the deterministic part of a run as ONNX, and check it against the run.

    Beside ``NAME.onnx`` (or another name of `out`) it writes ``NAME.card.md``, which describes
    the training, inputs and outputs, and how to add noise.  If the run adds electronic noise,
    ``NAME.noise.npz`` contains its spectrum.

    Parameters
    ----------
    run
        A trained run or its folder.
    out
        File to write, its card beside it.
    inverse
        Export IREN instead of REN.
    force
        Replace existing files; those of noise are removed if there is none.

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
    card, noise_file = out.with_suffix(".card.md"), out.with_suffix(".noise.npz")
    run = as_run(run)
    for path in (out, card, noise_file):
        refuse_existing(path, run.folder, force=force)
    kind: type[Translator] = IREN if inverse else REN
    translator = kind.of(run)
    noise = translator.backend.noise
    graph = translator.backend.graph(run.recipe.preparation.length)
    with (
        stage("Exporting"),
        written_aside(out) as aside,
        written_aside(card) as text,
    ):
        difference = write_onnx(graph, aside)
        done = Export(out, card, None if noise is None else noise_file, difference)
        text.write_text(_card(run, translator, graph, done), encoding="utf-8")
        if noise is not None:
            spectra: Any = {"continua": noise.kinds, "lines": noise.lines}
            spectra |= {"shares": noise.shares, "samples": noise.samples, "dt_ns": noise.dt_ns}
            with written_aside(noise_file) as stored, stored.open("wb") as stream:
                np.savez(stream, **spectra)
    if noise is None:
        noise_file.unlink(missing_ok=True)  # of an export that this one replaces
    return done


def _card(run: Run, translator: Translator, graph: Graph, done: Export) -> str:
    parts = [
        f"# {done.graph.name}\n",
        f"{type(translator).__name__} of a cpunet run: "
        + ("simulated → measured-like" if translator.part == "ren" else "measured → simulated")
        + f" pulses. ONNX, opset {OPSET}, IR {FORMAT}; any batch size. Largest difference from "
        f"the run in batches of {' and '.join(map(str, CHECKED))} pulses: "
        f"{done.difference:.1e} of the pulse height (refused above {TOLERANCE:g}).\n",
        "## Made from\n",
        *_origin(run, translator),
        "## In and out\n",
        *_interface(translator, graph),
        "## Noise\n",
        *_noise(graph, done),
        "## Valid for\n",
        f"Pulses sampled every {translator.dt_ns:g} ns, of the detector and readout of the "
        f"data. It was trained on {run.peak}; what it does at other energies is for a "
        "validation to say. Pile-up, saturated pulses and other samplings are not covered.\n",
    ]
    return "\n".join(parts)


def _origin(run: Run, translator: Translator) -> list[str]:
    lines = [f"* recipe {run.recipe.name} (seed {run.seed}), trained on {run.peak}"]
    for side, what in ((run.sim, "simulation"), (run.data, "data")):
        if side.sha256 is not None:
            lines.append(
                f"* {what}: {Path(str(side.file)).name}, {side.used} of {side.read} pulses "
                f"used, sha256 {side.sha256[:12]}…"
            )
    if run.imported:
        names = ", ".join(Path(part["file"]).name for part in run.imported.values())
        lines.append(f"* weights imported from {names}")
    return [*lines, *_fitted(run, translator), ""]


def _fitted(run: Run, translator: Translator) -> list[str]:
    """Fitted parameters of a readout chain, or settings of a network."""
    generator = translator.recipe.generator
    if generator.name != "response":
        return [f"* generator: `{json.dumps(generator.model_dump(mode='json'))}`"]
    chain = describe_chain(run)
    errors = chain.parameter_errors
    numbers = [
        f"`{name}` {value:.4g}" + (f" ± {errors[name]:.2g}" if name in errors else "")
        for name, value in chain.parameters.items()
    ]
    lines = [f"* readout chain as fitted: {', '.join(numbers)}"]
    if rms := chain.values.get("noise_rms_kev"):
        lines.append(f"* noise of the data: {rms:.3g} keV RMS")
    return lines


def _interface(translator: Translator, graph: Graph) -> list[str]:
    config = translator.recipe.preparation
    n = config.length
    simulated = (
        f"`windows`, float32 (batch, {n}): simulated pulses, scaled to 0 … 1, sample "
        f"{config.samples_before} the first after the last one below "
        f"{config.align_fraction:g} of the maximum, padded with 0 before and with the last "
        "value after."
    )
    measured = (
        f"float32 (batch, {n}): sample {config.samples_before} aligned in the same way, the "
        f"mean of the first {config.baseline_samples} samples 0, the mean of the last "
        f"{config.tail_samples} {config.tail_level:g}"
    )
    forward = translator.part == "ren"
    lines = [f"* in: {simulated if forward else f'`windows`, {measured}: measured pulses.'}"]
    if "epsilon" in graph.inputs:
        channels = translator.backend.network.state_dict()["latent_mean.bias"].shape[0]
        lines.append(f"* in: `epsilon`, float32 (batch, {channels}, {n // 16}), see Noise.")
        lines.append(
            "* out: `translated`, "
            + (f"{measured}.\n" if forward else f"float32 (batch, {n}), as simulated pulses.\n")
        )
    elif forward:
        lines.append(
            f"* out: `records`, float32 (batch, {PADDING_BEFORE + n + PADDING_AFTER}): "
            f"noise-free, per unit of charge; sample {PADDING_BEFORE} belongs to the window's "
            "first.\n\n"
            f"Afterwards records are prepared as measured traces: {measured}."
            "\n"
        )
    else:
        lines.append(
            f"* out: `pulses`, float32 (batch, {n}), within 0 … 1; afterwards scaled and "
            "aligned as simulated pulses.\n"
        )
    return lines


def _noise(graph: Graph, done: Export) -> list[str]:
    lines = []
    if "epsilon" in graph.inputs:
        lines = [
            "The graph draws nothing. `epsilon` of independent N(0, 1) numbers gives a draw, "
            "of zeros the latent mean. Electronic noise is not added.\n"
        ]
    elif done.noise is None:
        lines = ["None is added: the inverse removes it.\n"]
    if done.noise is None:
        return lines
    return [
        *lines,
        f"The graph adds none. `{done.noise.name}` holds the electronic noise: spectra of "
        "`continua` and `lines`, shape (kinds, bins), at the frequencies of a real FFT of "
        "`samples` samples of `dt_ns`, as the mean square of a bin divided by `samples`, in "
        "(prepared units × keV)², and the `shares` of the kinds. For one pulse: choose a kind "
        "by its share, draw Gaussian noise of the continuum and sines of random phase for the "
        "lines, divide by the energy in keV. Prepare the record, add the noise to all of it "
        "(in the same units), then prepare again, so that alignment and scale suffer from "
        "noise as those of data do.\n",
    ]
