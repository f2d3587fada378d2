"""``cpunet tune``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from cpunet.cli import options
from cpunet.cli.ensemble import Jobs, Resume, Threads
from cpunet.cli.messages import monitor, note, tell
from cpunet.outputs import refuse_inputs

Out = Annotated[Path, typer.Option("--out", help="Folder of the search to make.")]
Trials = Annotated[
    int, typer.Option(min=1, max=100_000, help="Trials in all, those already done included.")
]

SHOWN = 10  # trials


@options.grouped
def tune(
    *,
    sim: options.Sim,
    data: options.Data,
    out_folder: Out,
    trials: Trials = 30,
    on: options.TrainOn,
    seed: options.Seed = 0,
    read_as: options.ReadAs,
    jobs: Jobs = None,
    threads: Threads = None,
    device: options.Device = "auto",
    resume: Resume = False,
    force: options.Force = False,
) -> None:
    """Search for better settings of a recipe on held-out pulses of the training's energies.

    Example: cpunet tune --sim sim.lh5 --data raw.lh5 --recipe fast --trials 30 --out tuned
    """
    from cpunet.jobs.studies.tune import BEST, tune_recipe

    refuse_inputs(out_folder, on.recipe)
    try:
        told = tune_recipe(
            read_as.sim(sim),
            read_as.data(data),
            out_folder,
            on.load(),
            trials=trials,
            peak=on.peak,
            seed=seed,
            jobs=jobs,
            threads=threads,
            device=device,
            resume=resume,
            force=force,
            monitor=monitor(),
        )
    except SystemExit:
        note("finished trials are kept; continue with --resume")
        raise
    tell(_table(told))
    best, first = told["best"], told["first"]
    line = f"best: trial {best['number']} with {best['score']:.3f}"
    tell(line + ("" if first is None else f"; the recipe as it is has {first:.3f}"))
    if told["importances"]:
        shares = (f"{key} {share:.2f}" for key, share in told["importances"].items())
        tell(f"importance: {', '.join(shares)}")
    tell(str(out_folder / BEST))


def _table(told: dict[str, Any]) -> Table:
    """The best trials, and how many ended otherwise."""
    ended = [row for row in told["trials"] if row["state"] == "complete"]
    others = len(told["trials"]) - len(ended)
    rows = sorted(ended, key=lambda row: row["score"])[:SHOWN]
    title = f"Distance of held-out pulses to data, best of {len(ended)} trials"
    title += f" ({others} pruned or failed)" if others else ""
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    keys = list(told["best"]["values"])
    for column in ("trial", "score", *(key.rpartition(".")[2] for key in keys)):
        table.add_column(column, justify="right")
    for row in rows:
        values = (_short(row["values"][key]) for key in keys)
        table.add_row(str(row["number"]), f"{row['score']:.3f}", *values)
    return table


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
