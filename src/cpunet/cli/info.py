"""``cpunet info``."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.cli.simulate import EnergyUnit, LengthUnit
from cpunet.errors import CpunetError
from cpunet.jobs.inspection.info_words import Lines, in_words
from cpunet.outputs import refuse_inputs

log = logging.getLogger(__name__)

Source = Annotated[Path, typer.Argument(help="File of pulses, or run folder.", metavar="FILE")]
TableName = Annotated[
    str | None, typer.Option("--table", help="Table, if there are several; or all.")
]
WithoutRemains = Annotated[
    Path | None,
    typer.Option(
        "--without-remains",
        help="LH5 file to write: measured traces less what earlier pulses left under them, "
        "with the columns remains_kev and remains_error_kev.",
    ),
]
Out = Annotated[
    Path | None, typer.Option(help="Figure of the spectrum and its lines: .png, .pdf or .svg.")
]
Crystal = Annotated[
    str | None,
    typer.Option(
        "--detector",
        help="Crystal of hits (icpc, ppc or a file): how many are inside, the frame that fits.",
    ),
]


def info(
    source: Source,
    table: TableName = None,
    energy: options.Energy = None,
    kev_per_adc: options.KevPerAdc = None,
    dt: options.Dt = None,
    detector: Crystal = None,
    length_unit: LengthUnit = None,
    energy_unit: EnergyUnit = None,
    out: Out = None,
    without_remains: WithoutRemains = None,
    force: options.Force = False,
) -> None:
    """Say what is in a file or run: events, sampling, energies, peaks, provenance.

    Of measured traces it says trigger, baseline, decay, noise, saturation and pile-up, and what
    earlier pulses have left under them. Files of hits are described, too: events, energies and
    where they lie.

    Example: cpunet info raw.lh5 --out raw.png

    Example: cpunet info raw.lh5 --table all

    Example: cpunet info hits.npz --detector icpc
    """
    from cpunet.jobs.inspection.info import describe
    from cpunet.recipes import load_recipe
    from cpunet.simulation.geometry_readers import read_detector

    for target in (out, without_remains):
        if target is not None:
            refuse_inputs(target, detector)
    told = describe(
        source,
        table=table,
        energy=energy,
        kev_per_adc=kev_per_adc,
        dt_ns=dt,
        recipe=load_recipe("fast"),
        detector=None if detector is None else read_detector(detector),
        hit_units=(length_unit, energy_unit),
        without_remains=without_remains,
        out=out,
        force=force,
    )
    if told["kind"] == "tables":
        tell(_tables(told))
        tell("one of them: --table NAME; each in full: --table all")
    elif told["kind"] == "channels":
        for name, one in told["channels"].items():
            tell(f"{name}:")
            _print([("", one)] if isinstance(one, str) else in_words(one))
    else:
        _print(in_words(told))
    if out is not None:
        tell(f"{out}")
    failed = [n for n, one in told.get("channels", {}).items() if isinstance(one, str)]
    if failed:
        raise CpunetError(
            f"{source}: {len(failed)} of {len(told['channels'])} tables cannot be read: "
            f"{', '.join(failed)}"
        )


def _print(lines: Lines) -> None:
    width = max(len(name) for name, _ in lines)
    for name, text in lines:
        tell(f"{name:<{width}}  {text}")


def _tables(told: Mapping[str, Any]) -> Table:
    """The tables of a file, a row each."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("table", "traces", "samples", "ns", "energies"):
        table.add_column(name, justify="left" if name in ("table", "energies") else "right")
    for name, one in told["tables"].items():
        if isinstance(one, str):
            table.add_row(escape(name), "", "", "", escape(one))
            continue
        numbers = (str(one[key]) for key in ("n_pulses", "length"))
        table.add_row(escape(name), *numbers, f"{one['dt_ns']:g}", escape(str(one["energy"])))
    return table
