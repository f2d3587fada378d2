"""``cpunet check``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, out, show
from cpunet.outputs import refuse_inputs

Out = Annotated[
    Path | None, typer.Option("--out", help="Picture to make: pulses of both sides.")
]
MARKS = {
    "fine": "[green]ok[/]     ",
    "warning": "[bold]look[/]   ",
    "error": "[bold red]stop[/]   ",
}


@options.grouped
def check(
    *,
    sim: options.Sim,
    data: options.Data,
    out_file: Out = None,
    on: options.TrainOn,
    read_as: options.ReadAs,
    force: options.Force = False,
) -> None:
    """Say whether simulated and measured pulses can be compared, and what to do if not.

    Ends with status 1 if something must be changed before a training.

    Example: cpunet check --sim sim.lh5 --data raw.lh5 --out check.png
    """
    from cpunet.jobs.training.check import Level, check, draw

    if out_file is not None:
        refuse_inputs(out_file, sim, data, on.recipe)
    checked = check(
        read_as.sim(sim),
        read_as.data(data),
        on.load(),
        on.peak,
        monitor(),
    )
    for finding in checked.findings:
        out.print(MARKS[finding.level], end="", soft_wrap=True)
        show(str(finding))
    if out_file is not None and checked.sides:
        draw(checked, out_file, force=force)
        out.print(f"{out_file}: pulses of both sides", markup=False, highlight=False)
    if checked.level == Level.ERROR:
        raise typer.Exit(1)
