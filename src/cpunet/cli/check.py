"""``cpunet check``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, out
from cpunet.cli.train import Peak, RecipeName, Set
from cpunet.outputs import refuse_inputs

Out = Annotated[
    Path | None, typer.Option("--out", help="Picture to make: pulses of both sides.")
]
MARKS = {
    "fine": "[green]ok[/]     ",
    "warning": "[bold]look[/]   ",
    "error": "[bold red]stop[/]   ",
}


def check(
    sim: options.Sim,
    data: options.Data,
    out_file: Out = None,
    recipe: RecipeName = "fast",
    peak: Peak = "FEP",
    sim_table: options.SimTable = None,
    sim_energy: options.SimEnergy = None,
    data_table: options.DataTable = None,
    data_energy: options.DataEnergy = None,
    kev_per_adc: options.KevPerAdc = None,
    dt: options.Dt = None,
    insist: options.Insist = False,
    set_values: Set = None,
    force: options.Force = False,
) -> None:
    """Say whether simulated and measured pulses can be compared, and what to do if not.

    Ends with status 1 if something must be changed before a training.

    Example: cpunet check --sim sim.lh5 --data raw.lh5 --out check.png
    """
    from cpunet.jobs.common.inputs import InputFile
    from cpunet.jobs.training.check import Level, check, draw
    from cpunet.recipes import load_recipe

    if out_file is not None:
        refuse_inputs(out_file, sim, data, recipe)
    checked = check(
        InputFile(sim, sim_table, sim_energy, dt_ns=dt, insist=insist),
        InputFile(data, data_table, data_energy, kev_per_adc, dt, insist),
        load_recipe(recipe, set_values or ()),
        peak,
        monitor(),
    )
    for finding in checked.findings:
        out.print(MARKS[finding.level], end="", soft_wrap=True)
        out.print(str(finding), markup=False, highlight=False, soft_wrap=True)
    if out_file is not None and checked.sides:
        draw(checked, out_file, force=force)
        out.print(f"{out_file}: pulses of both sides", markup=False, highlight=False)
    if checked.level == Level.ERROR:
        raise typer.Exit(1)
