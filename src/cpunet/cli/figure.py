"""``cpunet figure``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, tell

Names = Annotated[
    list[str],
    typer.Argument(
        help="Figures by name, or part of it: spectrum, cycle, 'single pulse', "
        "'SEP drift_time', superpulses, 'A over E', noise, losses.",
        metavar="NAME…",
    ),
]
Folder = Annotated[
    Path,
    typer.Argument(
        help="Report folder, or run folder with --sim and --data.", metavar="REPORT"
    ),
]
Sim = Annotated[Path | None, typer.Option("--sim", help="File of simulated pulses.")]
Data = Annotated[Path | None, typer.Option("--data", help="File of measured pulses.")]
Out = Annotated[Path, typer.Option("--out", help="Folder for the files.")]
Suffix = Annotated[str, typer.Option("--format", help="png, pdf or svg.")]


@options.grouped
def figure(
    *,
    folder: Folder,
    names: Names,
    sim: Sim = None,
    data: Data = None,
    out_folder: Out = Path(),
    suffix: Suffix = "png",
    scored: options.ScoredWith,
    seed: options.Seed = 0,
    read_as: options.ReadAs,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Draw single figures of a validation, for a paper or a talk.

    Example: cpunet figure report "single pulse" spectrum --format pdf --out figures

    Example: cpunet figure run "single pulse" --sim sim.lh5 --data raw.lh5 --out figures
    """
    from cpunet.jobs.validation.evaluation import ValidateOptions
    from cpunet.jobs.validation.figure_files import draw_figures

    files = draw_figures(
        folder,
        names,
        None if sim is None else read_as.sim(sim),
        None if data is None else read_as.data(data),
        out_folder,
        suffix=f".{suffix.removeprefix('.')}",
        how=ValidateOptions(scored.truth, scored.fitted, seed, device=device),
        force=force,
        monitor=monitor(),
    )
    for file in files:
        tell(str(file))
