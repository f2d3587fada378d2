"""``cpunet export``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.errors import CpunetError


class Target(StrEnum):
    """Other things than graphs that can be written."""

    LEGEND_PARS = "legend-pars"


class Form(StrEnum):
    """Formats of the exported graph."""

    ONNX = "onnx"
    TORCHSCRIPT = "torchscript"
    TORCH_EXPORT = "torch-export"


Out = Annotated[
    Path, typer.Option("--out", help="File to write, its card beside it; or folder of --to.")
]
FormName = Annotated[Form, typer.Option("--format", help="Of the file.")]
To = Annotated[
    Target | None,
    typer.Option(
        "--to", help="legend-pars: a folder of parameters for LEGEND's simulation chain."
    ),
]
Detector = Annotated[
    str | None, typer.Option("--detector", help="With --to: name of the parameters' entries.")
]
Library = Annotated[
    Path | None,
    typer.Option(
        "--library", help="With --to: ideal pulses on which two parameters are tried."
    ),
]
Report = Annotated[
    Path | None,
    typer.Option(
        "--report", help="Report whose scores go into the card, or A/E into parameters."
    ),
]


def export(
    run: options.Run,
    out_file: Out,
    form: FormName = Form.ONNX,
    to: To = None,
    inverse: options.Inverse = False,
    report: Report = None,
    detector: Detector = None,
    library: Library = None,
    force: options.Force = False,
) -> None:
    """Export a trained run for other tools: its graph, without its noise, or its parameters.

    Example: cpunet export run --format onnx --out ren.onnx
    """
    if to is not None:
        if inverse:
            raise CpunetError("--inverse: parameters are those of REN; leave it out")
        _legend_pars(run, out_file, detector, report, library, force=force)
        return
    if detector is not None or library is not None:
        raise CpunetError("--detector and --library are those of --to legend-pars; add it")
    from cpunet.jobs.translation.export import export_run

    done = export_run(
        run,
        out_file,
        form.value,
        inverse=inverse,
        report=report,
        force=force,
    )
    files = [done.graph, done.card] + ([done.noise] if done.noise else [])
    tell(f"{', '.join(map(str, files))}: within {done.difference:.1e} of the run")


def _legend_pars(
    run: Path,
    out: Path,
    detector: str | None,
    report: Path | None,
    library: Path | None,
    *,
    force: bool,
) -> None:
    from cpunet.jobs.translation.export_legend import export_legend_pars

    told = export_legend_pars(
        run,
        out,
        detector=detector,
        report=report,
        library=library,
        force=force,
    )
    ((name, whole),) = told.items()
    two = whole["electronics"]["equivalent"]
    tell(
        f"{out}: {name}: sigma {two['sigma_ns']:.1f} ns, tau {two['tau_ns']:.1f} ns; the "
        f"current is up to {two['current_error_percent']:.1f} % of its height off, A/E "
        f"± {two['ae_error_percent']:.1f} % between currents of 1 and 300 ns"
    )
    if found := two.get("of_library"):
        alone, pairs = found["single_site"], found["two_sites"]
        tell(
            f"on {found['templates']} places of {found['library']}, A/E is off by "
            f"{alone['rms_percent']:.2g} % RMS, {alone['largest_percent']:.2g} % at most; "
            f"on pairs of them by {pairs['rms_percent']:.2g} and "
            f"{pairs['largest_percent']:.2g} %"
        )
    for method, one in whole["ae_against_energy"].items():
        line = one["mean"]
        tell(
            f"A/E against energy, {method}: {line['per_mev_percent']:+.3f} ± "
            f"{line['per_mev_error_percent']:.3f} % per MeV"
        )
    if not whole["ae_against_energy"]:
        tell("A/E against energy: none, since no report was given (--report)")
