"""``cpunet ensemble``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from cpunet.cli import options
from cpunet.cli.messages import monitor, note, tell
from cpunet.cli.scores import PARAMETERS
from cpunet.outputs import refuse_inputs

Out = Annotated[Path, typer.Option("--out", help="Folder of the run folders to make.")]
Seeds = Annotated[int, typer.Option(min=1, max=10_000, help="How many seeds, from 0 on.")]
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=options.MAX_THREADS,
        help="Processes at a time; as many as cores by default, 1 on a GPU.",
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        min=1, max=options.MAX_THREADS, help="CPU threads of each; its share of the cores."
    ),
]
Validate = Annotated[
    bool, typer.Option("--validate/--no-validate", help="Score each seed, or not.")
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Resume in OUT; give all other options as before.")
]


@options.grouped
def ensemble(
    *,
    sim: options.Sim,
    data: options.Data,
    out_folder: Out,
    seeds: Seeds = 20,
    on: options.TrainOn,
    read_as: options.ReadAs,
    jobs: Jobs = None,
    threads: Threads = None,
    validate: Validate = True,
    truth: options.Truth = None,
    device: options.Device = "auto",
    resume: Resume = False,
    force: options.Force = False,
) -> None:
    """Train many seeds, several at once, and tell how their scores scatter.

    Example: cpunet ensemble --sim sim.lh5 --data raw.lh5 --seeds 20 --out ens
    """
    from cpunet.jobs.studies.ensemble import FIGURE, train_ensemble

    refuse_inputs(out_folder, on.recipe)
    try:
        told = train_ensemble(
            read_as.sim(sim),
            read_as.data(data),
            out_folder,
            on.load(),
            seeds=seeds,
            peak=on.peak,
            jobs=jobs,
            threads=threads,
            validate=validate,
            truth=truth,
            device=device,
            resume=resume,
            force=force,
            monitor=monitor(),
        )
    except SystemExit:
        note("finished seeds are kept; continue with --resume")
        raise
    if told["table"]:
        tell(_table(told))
    for line in _summary(told):
        tell(line)
    if told["table"]:
        tell(str(out_folder / FIGURE))


def _table(told: dict[str, Any]) -> Table:
    table = Table(title="IoU over seeds, %", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("peak", "score"):
        table.add_column(column)
    for column in ("median", "worst 5 %", "failures", "ceiling"):
        table.add_column(column, justify="right")
    for row in told["table"]:
        digits = 1 if row["failures"] is not None else 4
        numbers = [_number(row[key], digits) for key in ("median", "worst")]
        failures = "" if row["failures"] is None else str(row["failures"])
        ceiling = "" if row["ceiling"] is None else _number(row["ceiling"], 1)
        name = PARAMETERS.get(row["score"], row["score"].replace("_", " "))
        table.add_row(row["peak"], name, *numbers, failures, ceiling)
    return table


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None or value != value else f"{value:.{digits}f}"


def _summary(told: dict[str, Any]) -> list[str]:
    seeds, failed, poor = told["seeds"], told["failures"], told["poor"]
    lines = [f"{len(seeds) - len(failed)} of {len(seeds)} seeds trained"]
    if told["table"]:
        lines[0] += (
            f"; {len(poor)} with a score below 0.9 of the median; "
            f"failure rate {100 * told['failure_rate']:.0f} %"
        )
    lines += [f"seed {seed} failed: {reason}" for seed, reason in failed.items()]
    return lines + [f"seed {seed} is poor: {', '.join(names)}" for seed, names in poor.items()]
