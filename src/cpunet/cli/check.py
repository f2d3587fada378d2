"""``cpunet check``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, out
from cpunet.cli.train import Peak, RecipeName, Set
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs

if TYPE_CHECKING:
    from cpunet.jobs.training.check import Checked

Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Picture to make: pulses of both sides; for all channels, with the name of each.",
    ),
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
    data_table: options.OneTableOrAll = None,
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

    Example: cpunet check --sim sim.lh5 --data raw.lh5 --data-table all
    """
    from cpunet.jobs.common.channels import ALL, paired
    from cpunet.jobs.common.inputs import InputFile
    from cpunet.jobs.training.check import Checked, Level, check
    from cpunet.recipes import load_recipe

    if out_file is not None:
        refuse_inputs(out_file, sim, data, recipe)
    sides = (
        InputFile(sim, sim_table, sim_energy, dt_ns=dt, insist=insist),
        InputFile(data, data_table, data_energy, kev_per_adc, dt, insist),
    )
    chosen = load_recipe(recipe, set_values or ())
    stopped = False
    for name, pair in (paired(*sides) if data_table == ALL else {"": sides}).items():
        if isinstance(pair, CpunetError):
            checked = Checked.refused("sim", pair)
        else:
            checked = check(*pair, chosen, peak, monitor())
        picture = out_file
        if name:
            out.print(f"{name}:", markup=False, highlight=False)
            picture = out_file and out_file.with_stem(f"{out_file.stem}-{name}")
        _show(checked, picture, force=force)
        stopped |= checked.level == Level.ERROR
    if stopped:
        raise typer.Exit(1)


def _show(checked: Checked, picture: Path | None, *, force: bool) -> None:
    from cpunet.jobs.training.check import draw

    for finding in checked.findings:
        out.print(MARKS[finding.level], end="", soft_wrap=True)
        out.print(str(finding), markup=False, highlight=False, soft_wrap=True)
    if picture is not None and checked.sides:
        draw(checked, picture, force=force)
        out.print(f"{picture}: pulses of both sides", markup=False, highlight=False)
