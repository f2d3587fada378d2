"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli.environment import MAX_THREADS

# Far beyond what anyone needs, and what a job can hold or live to see.
MAX_SAMPLES = 1 << 20
MAX_REALISATIONS = 10_000


def within(
    low: float, high: float, *, above: bool = False
) -> Callable[[float | None], float | None]:
    """Check of an option: a finite number from `low`, or `above` it, to `high`; or not given.

    Examples
    --------
    >>> within(0, 10)(10.0)
    10.0
    """

    def check(value: float | None) -> float | None:
        if value is None or (((low < value) if above else (low <= value)) and value <= high):
            return value
        start = f"above {low:g}" if above else f"from {low:g}"
        raise typer.BadParameter(f"{value:g} is not {start} to {high:g}.")

    return check


class Impurities(StrEnum):
    """What the detector's impurities are taken from."""

    file = "file"
    depletion = "depletion"


Sim = Annotated[Path, typer.Option("--sim", help="File of simulated pulses.")]
Data = Annotated[Path, typer.Option("--data", help="File of measured pulses.")]
Run = Annotated[Path, typer.Argument(help="Folder of a training run.", metavar="RUN")]
Seed = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of all random numbers.")]
Threads = Annotated[
    int | None,
    typer.Option(min=1, max=MAX_THREADS, help="CPU threads; all cores by default."),
]
Device = Annotated[str, typer.Option(help="cpu, cuda, or auto: the GPU if there is one.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing output.")]
SimTable = Annotated[
    str | None, typer.Option(help="Table of the simulated pulses, if the file has several.")
]
DataTable = Annotated[
    str | None, typer.Option(help="Table of the measured pulses, if the file has several.")
]
OneTableOrAll = Annotated[
    str | None,
    typer.Option(
        help="Table of the measured pulses, if the file has several; or all, one after another."
    ),
]
SimEnergy = Annotated[
    str | None, typer.Option(help="Energy column of the simulation, or FILE:path/to/column.")
]
DataEnergy = Annotated[
    str | None,
    typer.Option(help="Energy column of the data, or FILE:path/to/column, as of a hit tier."),
]
KevPerAdc = Annotated[
    float | None,
    typer.Option(
        help="Calibration of measured pulses without energies in keV: keV per ADC count.",
        callback=within(0, 1e6, above=True),
    ),
]
Dt = Annotated[
    float | None,
    typer.Option(
        "--dt-ns",
        "--dt",
        help="Sampling period in ns, if the files do not tell.",
        callback=within(1e-3, 1e9),
    ),
]
Insist = Annotated[
    bool,
    typer.Option(
        "--insist",
        help="Pulses are simulated or measured as given, whatever they look like.",
    ),
]
Truth = Annotated[
    Path | None, typer.Option(help="Noise-free responses of the simulated pulses (.npz).")
]
Rivals = Annotated[
    bool, typer.Option("--rivals/--no-rivals", help="Fit the baseline methods too, or not.")
]
Crystal = Annotated[
    Path | None,
    typer.Option(
        "--crystal",
        help="LEGEND's file of the crystal's impurities; found in ../crystals by default.",
    ),
]
ImpurityFrom = Annotated[
    Impurities,
    typer.Option(
        "--impurity-from",
        help="depletion: scale them so that the detector depletes at measured_depletion_V.",
    ),
]
