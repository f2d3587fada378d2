"""``cpunet translate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, out

Source = Annotated[Path, typer.Argument(help="File of pulses to translate.", metavar="FILE")]
Out = Annotated[Path, typer.Option("--out", help="LH5 file to write.")]
Inverse = Annotated[bool, typer.Option("--inverse", help="IREN: data → simulation-like.")]
Noise = Annotated[
    bool, typer.Option("--noise/--no-noise", help="Add noise as the data have it, or none.")
]
Table = Annotated[str | None, typer.Option(help="Table to read, if the file has several.")]
OutTable = Annotated[str | None, typer.Option(help="Table to write; geds/ren or geds/iren.")]
Energy = Annotated[str | None, typer.Option(help="Energy column, or FILE:path/to/column.")]


def translate(
    run: options.Run,
    source: Source,
    out_file: Out,
    inverse: Inverse = False,
    noise: Noise = True,
    seed: options.Seed = 0,
    table: Table = None,
    out_table: OutTable = None,
    energy: Energy = None,
    kev_per_adc: options.KevPerAdc = None,
    dt: options.Dt = None,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Translate a file of pulses with a trained run, keeping its rows.

    Example: cpunet translate run sim.lh5 --out translated.lh5
    """
    from cpunet.jobs.inputs import InputFile
    from cpunet.jobs.translate import translate_file

    counts = translate_file(
        run,
        InputFile(source, table, energy, kev_per_adc, dt),
        out_file,
        inverse=inverse,
        noise=noise,
        seed=seed,
        table=out_table,
        device=device,
        force=force,
        monitor=monitor(),
    )
    rejected = ", ".join(f"{n} {reason}" for reason, n in counts["rejections"].items())
    out.print(
        f"{out_file}: {counts['translated']} of {counts['read']} pulses translated"
        + (f"; rows of NaN for {rejected}" if rejected else ""),
        soft_wrap=True,
    )
