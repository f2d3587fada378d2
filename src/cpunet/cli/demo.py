"""``cpunet demo``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.cli.scores import print_scores
from cpunet.outputs import refuse_inputs

EVENTS, FEW = "FEP=2500,SEP=1000,DEP=1000", "FEP=1000,SEP=250,DEP=250"


class Kind(StrEnum):
    """Whether the data's detector is the simulated one."""

    matched = "matched"
    shifted = "shifted"


Preset = Annotated[
    str, typer.Option("--preset", help="Readout: ornl, legend200, ringing, or a YAML file.")
]
KindOption = Annotated[
    Kind, typer.Option("--kind", help="shifted: the data's detector differs a little.")
]
Out = Annotated[Path, typer.Option("--out", help="Folder of stand, run and report.")]
RecipeName = Annotated[
    str, typer.Option("--recipe", help="fast, paper, or a YAML file of your own.")
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override a value: --set training.steps=30 (repeatable)."),
]
Quick = Annotated[
    bool, typer.Option("--quick", help=f"A quick look: {FEW}, scores and three figures.")
]
Events = Annotated[
    str | None,
    typer.Option(
        help="Events of each peak or range (keV), for sim and data each.",
        show_default=f"{EVENTS}",
    ),
]


def demo(
    out_folder: Out = Path("demo"),
    preset: Preset = "legend200",
    detector: options.DetectorFile = "icpc",
    events: Events = None,
    kind: KindOption = Kind.matched,
    recipe: RecipeName = "fast",
    set_values: Set = None,
    quick: Quick = False,
    seed: options.Seed = 0,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Simulate, digitise, train, translate and validate on a stand with a known answer.

    Example: cpunet demo --out demo

    Example: cpunet demo --quick

    Example: cpunet demo --preset ornl --kind shifted --out demo2
    """
    from cpunet.electronics.chain import read_electronics
    from cpunet.jobs.demo import demonstrate
    from cpunet.jobs.demo_parts import PARTS
    from cpunet.recipes import load_recipe
    from cpunet.simulation.energy_windows import wanted_events
    from cpunet.simulation.geometry_readers import read_detector

    for part in PARTS:
        refuse_inputs(out_folder / part, preset, detector, recipe)
    loaded = load_recipe(recipe, set_values or ())
    wanted = wanted_events(events or (FEW if quick else EVENTS), loaded.peaks, 0.5)
    metrics = demonstrate(
        read_electronics(preset),
        read_detector(detector),
        loaded,
        {window.name: number for window, number in wanted.items()},
        out_folder,
        kind=kind.value,
        seed=seed,
        device=device,
        force=force,
        quick=quick,
    )
    print_scores(metrics, leave_out=("FEP",))
    tell(f"{out_folder / 'report' / 'report.html'}")
