"""``cpunet train``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, out

Out = Annotated[Path, typer.Option("--out", help="Run folder to make.")]
RecipeName = Annotated[
    str, typer.Option("--recipe", help="fast, small, paper, or a YAML file of your own.")
]
Peak = Annotated[
    str, typer.Option(help="Energies to train on: FEP, SEP, DEP or a range in keV, as 300-.")
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override a value: --set training.batch_size=64 (repeatable)."),
]
Threads = Annotated[int | None, typer.Option(min=1, help="CPU threads; all cores by default.")]
Board = Annotated[bool, typer.Option("--tensorboard", help="Write TensorBoard logs too.")]


def train(
    sim: options.Sim,
    data: options.Data,
    out_folder: Out,
    recipe: RecipeName = "fast",
    peak: Peak = "FEP",
    seed: options.Seed = 0,
    sim_table: options.SimTable = None,
    sim_energy: options.SimEnergy = None,
    data_table: options.DataTable = None,
    data_energy: options.DataEnergy = None,
    kev_per_adc: options.KevPerAdc = None,
    dt: options.Dt = None,
    set_values: Set = None,
    threads: Threads = None,
    device: options.Device = "auto",
    tensorboard: Board = False,
    force: options.Force = False,
) -> None:
    """Train REN and IREN on simulated and measured pulses, unpaired.

    Example: cpunet train --sim sim.lh5 --data raw.lh5 --out run
    """
    import torch

    from cpunet.jobs.inputs import InputFile
    from cpunet.jobs.train import train_run
    from cpunet.recipes import load_recipe

    if threads is not None:
        torch.set_num_threads(threads)
    info = train_run(
        InputFile(sim, sim_table, sim_energy, dt_ns=dt),
        InputFile(data, data_table, data_energy, kev_per_adc, dt),
        out_folder,
        load_recipe(recipe, set_values or ()),
        peak=peak,
        seed=seed,
        device=device,
        force=force,
        tensorboard=tensorboard,
        monitor=monitor(),
    )
    out.print(
        f"{out_folder}: trained in {info['seconds']:.0f} s on {info['device']}", soft_wrap=True
    )
