"""``cpunet info``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from cpunet.cli import options
from cpunet.cli.messages import out, print_table, warn
from cpunet.outputs import refuse_inputs

Source = Annotated[Path, typer.Argument(help="File of pulses, or run folder.", metavar="FILE")]
TableName = Annotated[str | None, typer.Option("--table", help="Table, if there are several.")]
Energy = Annotated[str | None, typer.Option(help="Energy column, or FILE:path/to/column.")]

WithoutRemains = Annotated[
    Path | None,
    typer.Option(
        "--without-remains",
        help="LH5 file to write: measured traces less what earlier pulses left under them, "
        "with the columns remains_kev and remains_error_kev.",
    ),
]


def info(
    source: Source,
    table: TableName = None,
    energy: Energy = None,
    kev_per_adc: options.KevPerAdc = None,
    dt: options.Dt = None,
    without_remains: WithoutRemains = None,
    force: options.Force = False,
) -> None:
    """Say what is in a file or run: events, sampling, energies, peaks, provenance.

    Files of hits are described, too: events, energies and where they lie.

    Of measured traces it says what earlier pulses have left under them, and the rate of
    pulses that follows.

    Example: cpunet info raw.lh5

    Example: cpunet info raw.lh5 --without-remains flat.lh5
    """
    from cpunet.jobs.inspection.info import describe
    from cpunet.recipes import load_recipe
    from cpunet.training.run_schema import problem

    if without_remains is not None:
        refuse_inputs(without_remains, source, energy)
    recipe = load_recipe("fast")
    told = describe(
        source,
        table=table,
        energy=energy,
        kev_per_adc=kev_per_adc,
        dt_ns=dt,
        peaks=recipe.peaks,
        preparation=recipe.preparation,
        without_remains=without_remains,
        force=force,
    )
    if told["kind"] == "run" and (wrong := problem(told)):
        warn(f"{source}: its run.json is damaged ({wrong}); train again")
    if told["kind"] == "tables":
        print_table(_tables(told))
        out.print("one of them: --table NAME", highlight=False)
        return
    if told["kind"] == "hits":
        told |= told.pop("detectors")
        if "" in told:
            told |= {"hits": told.pop("")} if isinstance(told[""], str) else told.pop("")
    width = max(len(name) for name, _ in _lines(told))
    for name, value in _lines(told):
        out.print(f"{name:<{width}}  {value}", markup=False, highlight=False, soft_wrap=True)


def _tables(told: Mapping[str, Any]) -> Table:
    """The tables of a file, a row each."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("table", "traces", "samples", "ns", "energies"):
        table.add_column(name, justify="left" if name in ("table", "energies") else "right")
    for name, one in told["tables"].items():
        if isinstance(one, str):
            table.add_row(escape(name), "", "", "", escape(one))
            continue
        numbers = (_text(one.get(key)) for key in ("n_pulses", "length", "dt_ns"))
        table.add_row(escape(name), *numbers, escape(_text(one.get("energy"))))
    return table


def _lines(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested mappings as ``outer.inner`` lines, in order."""
    lines: list[tuple[str, str]] = []
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            lines += _lines(value, f"{prefix}{name}.")
        else:
            lines.append((f"{prefix}{name}", _text(value)))
    return lines


def _text(value: Any) -> str:
    if value is None or value == {}:
        return "–"
    if isinstance(value, (list, tuple)):
        bounds = len(value) == 2 and all(isinstance(v, (int, float)) for v in value)
        return (" … " if bounds else ", ").join(map(_text, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)
