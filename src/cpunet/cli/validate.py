"""``cpunet validate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from cpunet.cli import options
from cpunet.cli.messages import monitor, out

Out = Annotated[Path, typer.Option("--out", help="Report folder to make.")]
Truth = Annotated[
    Path | None, typer.Option(help="Noise-free responses of the simulated pulses (.npz).")
]


def validate(
    run: options.Run,
    sim: options.Sim,
    data: options.Data,
    out_folder: Out,
    truth: Truth = None,
    seed: options.Seed = 0,
    sim_table: options.SimTable = None,
    sim_energy: options.SimEnergy = None,
    data_table: options.DataTable = None,
    data_energy: options.DataEnergy = None,
    kev_per_adc: options.KevPerAdc = None,
    dt: options.Dt = None,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Score a run per peak and write a report: figures, metrics.json, report.html.

    Example: cpunet validate run --sim sim.lh5 --data raw.lh5 --out report
    """
    from cpunet.jobs.inputs import InputFile
    from cpunet.jobs.validate import validate_run

    metrics = validate_run(
        run,
        InputFile(sim, sim_table, sim_energy, dt_ns=dt),
        InputFile(data, data_table, data_energy, kev_per_adc, dt),
        out_folder,
        truth=truth,
        seed=seed,
        device=device,
        force=force,
        monitor=monitor(),
    )
    out.print(_score_table(metrics))
    out.print(f"{out_folder / 'report.html'}", soft_wrap=True)


def _score_table(metrics: dict[str, Any]) -> Table:
    """Draw IoU by peak and parameter, in percent."""
    table = Table(title="Overlap with data (IoU, %)")
    for column in ("peak", "parameter", "raw", "REN", "ceiling"):
        table.add_column(column, justify="left" if column in ("peak", "parameter") else "right")
    for peak, scores in metrics["peaks"].items():
        if "missing" in scores:
            table.add_row(peak, scores["missing"], "", "", "")
        for parameter, comparison in scores["parameters"].items():
            iou = comparison["iou"]
            cells = [_number(iou[key]) for key in ("raw", "ren", "ceiling")]
            table.add_row(peak, parameter.replace("_", " "), *cells)
    return table


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"
