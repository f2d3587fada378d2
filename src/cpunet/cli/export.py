"""``cpunet export``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, tell


class Form(StrEnum):
    """Formats of the exported graph."""

    ONNX = "onnx"
    TORCHSCRIPT = "torchscript"
    TORCH_EXPORT = "torch-export"


Out = Annotated[Path, typer.Option("--out", help="File to write; its card stands beside it.")]
FormName = Annotated[Form, typer.Option("--format", help="Of the file.")]
Inverse = Annotated[bool, typer.Option("--inverse", help="IREN: data → simulation-like.")]
Report = Annotated[
    Path | None, typer.Option("--report", help="Report folder whose scores go into the card.")
]


def export(
    run: options.Run,
    out_file: Out,
    form: FormName = Form.ONNX,
    inverse: Inverse = False,
    report: Report = None,
    force: options.Force = False,
) -> None:
    """Export a trained run for other tools, without its noise, with a card beside it.

    Example: cpunet export run --format onnx --out ren.onnx
    """
    from cpunet.jobs.translation.export import export_run

    done = export_run(
        run,
        out_file,
        form.value,
        inverse=inverse,
        report=report,
        force=force,
        monitor=monitor(),
    )
    files = [done.graph, done.card] + ([done.noise] if done.noise else [])
    tell(
        f"{', '.join(map(str, files))}: within {done.difference:.1e} of the run",
        soft_wrap=True,
    )
