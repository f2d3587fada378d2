"""``cpunet check``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import out, tell
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs

if TYPE_CHECKING:
    from cpunet.training.check import Checked

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


@options.grouped
def check(
    *,
    sim: options.Sim,
    data: options.Data,
    out_file: Out = None,
    on: options.TrainOn,
    read_as: options.ReadAsOrAll,
    force: options.Force = False,
) -> None:
    """Say whether simulated and measured pulses can be compared, and what to do if not.

    Ends with status 1 if something must be changed before a training.

    Example: cpunet check --sim sim.lh5 --data raw.lh5 --out check.png

    Example: cpunet check --sim sim.lh5 --data raw.lh5 --data-table all
    """
    from cpunet.pulses.channels import ALL, paired
    from cpunet.training.check import Checked, Level, check

    sides = read_as.sim(sim), read_as.data(data)
    if out_file is not None:
        refuse_inputs(out_file, *sides[0].files, *sides[1].files, on.recipe)
    chosen = on.load()
    stopped = False
    for name, pair in (paired(*sides) if read_as.data_table == ALL else {"": sides}).items():
        if isinstance(pair, CpunetError):
            checked = Checked.refused("sim", pair)
        else:
            checked = check(*pair, chosen, on.peak)
        picture = out_file
        if name:
            tell(f"{name}:")
            picture = out_file and out_file.with_stem(f"{out_file.stem}-{name}")
        _show(checked, picture, force=force)
        stopped |= checked.level == Level.ERROR
    if stopped:
        raise typer.Exit(1)


def _show(checked: Checked, picture: Path | None, *, force: bool) -> None:
    from cpunet.training.check import draw

    for finding in checked.findings:
        out.print(MARKS[finding.level], end="", soft_wrap=True)
        tell(str(finding))
    if picture is not None and checked.sides:
        draw(checked, picture, force=force)
        tell(f"{picture}: pulses of both sides")
