"""``cpunet validate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, tell
from cpunet.cli.scores import print_scores

Out = Annotated[Path, typer.Option("--out", help="Report folder to make.")]


def validate(
    run: options.Run,
    sim: options.Sim,
    data: options.Data,
    out_folder: Out,
    truth: options.Truth = None,
    rivals: options.Rivals = True,
    seed: options.Seed = 0,
    sim_table: options.SimTable = None,
    sim_energy: options.SimEnergy = None,
    data_table: options.DataTable = None,
    data_energy: options.DataEnergy = None,
    kev_per_adc: options.KevPerAdc = None,
    dt: options.Dt = None,
    insist: options.Insist = False,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Score a run per peak and write a report: figures, metrics.json, report.html.

    Example: cpunet validate run --sim sim.lh5 --data raw.lh5 --out report
    """
    from cpunet.jobs.common.inputs import InputFile
    from cpunet.jobs.validation.validate import validate_run

    metrics = validate_run(
        run,
        InputFile(sim, sim_table, sim_energy, dt_ns=dt, insist=insist),
        InputFile(data, data_table, data_energy, kev_per_adc, dt, insist),
        out_folder,
        truth=truth,
        rivals=rivals,
        seed=seed,
        device=device,
        force=force,
        monitor=monitor(),
    )
    print_scores(metrics)
    tell(f"{out_folder / 'report.html'}", soft_wrap=True)
