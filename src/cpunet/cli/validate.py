"""``cpunet validate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cpunet.cli import options
from cpunet.cli.channels import tell_channels
from cpunet.cli.messages import tell
from cpunet.cli.scores import print_scores
from cpunet.cli.values import parse_numbers
from cpunet.errors import CpunetError

AeRange = Annotated[
    str | None,
    typer.Option(
        "--ae-range",
        help="More energies for A/E against energy: 900,2350 (keV), if the files have them.",
    ),
]
Most = Annotated[
    int,
    typer.Option(
        min=100,
        max=10_000_000,
        help="Pulses a side that are compared: of more, a random sample. Some 30 kB each.",
    ),
]
Out = Annotated[Path, typer.Option("--out", help="Report folder to make.")]


@options.grouped
def validate(
    *,
    run: options.Run,
    sim: options.Sim,
    data: options.Data,
    out_folder: Out,
    scored: options.ScoredWith,
    ae_range: AeRange = None,
    most: Most = 50_000,
    seed: options.Seed = 0,
    read_as: options.ReadAsOrAll,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Score a run per peak and write a report: figures, metrics.json, report.html.

    Example: cpunet validate run --sim sim.lh5 --data raw.lh5 --out report

    Example: cpunet validate runs --sim sim.lh5 --data raw.lh5 --data-table all --out reports
    """
    from cpunet.jobs.validation.evaluation import ValidateOptions
    from cpunet.jobs.validation.validate import validate_run
    from cpunet.jobs.validation.validate_channels import INDEX, validate_channels
    from cpunet.pulses.channels import ALL, Outcome

    span = None
    if ae_range is not None:
        low, high = parse_numbers(ae_range, 2, "--ae-range")
        if not 0 < low < high:
            raise CpunetError(f"--ae-range {ae_range}: give two energies, from < to")
        span = (low, high)
    work = validate_channels if read_as.data_table == ALL else validate_run
    metrics = work(
        run,
        read_as.sim(sim),
        read_as.data(data),
        out_folder,
        ValidateOptions(scored.truth, scored.fitted, seed, span, most, device),
        force=force,
    )
    if isinstance(metrics, Outcome):
        tell(f"{out_folder / INDEX}")
        tell_channels(metrics, out_folder, _in_words)
        return
    print_scores(metrics)
    tell(f"{out_folder / 'report.html'}")


def _in_words(metrics: dict[str, Any]) -> str:
    from cpunet.validation.verdicts import judged_scores

    off, judged = judged_scores(metrics, "ren")
    return f"{off} of {judged} scores off" if judged else "not judged"
