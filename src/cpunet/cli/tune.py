"""``cpunet tune``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.outputs import refuse_inputs

Out = Annotated[Path, typer.Option("--out", help="Folder of the search, to make or continue.")]
Trials = Annotated[
    int, typer.Option(min=1, max=100_000, help="Trials in all, those already done included.")
]


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
    threads: options.Threads = None,
    device: options.Device = "auto",
) -> None:
    """Search for better settings of a recipe on held-out pulses of the training's energies.

    Given again with the same folder, a search goes on; several processes share it.

    Example: cpunet tune --sim sim.lh5 --data raw.lh5 --recipe fast --trials 30 --out tuned
    """
    from cpunet.jobs.tune import BEST, UNCHANGED, tune_recipe
    from cpunet.kernels import use_threads

    refuse_inputs(out_folder, on.recipe)
    if threads is not None:
        use_threads(threads)
    study = tune_recipe(
        read_as.sim(sim),
        read_as.data(data),
        out_folder,
        on.load(),
        trials=trials,
        peak=on.peak,
        seed=seed,
        device=device,
    )
    best = study.best_trial
    values = ", ".join(f"{key} {value}" for key, value in best.params.items())
    line = f"best: trial {best.number} with {best.value:.3f} ({values})"
    for trial in study.trials:
        if UNCHANGED in trial.user_attrs and trial.value is not None:
            line += f"; the recipe as it is has {trial.value:.3f}"
    tell(line)
    tell(str(out_folder / BEST))
