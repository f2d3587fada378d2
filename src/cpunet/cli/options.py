"""Options that several commands share."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Impurities(StrEnum):
    """What the detector's impurities are taken from."""

    file = "file"
    depletion = "depletion"


Sim = Annotated[Path, typer.Option("--sim", help="File of simulated pulses.")]
Data = Annotated[Path, typer.Option("--data", help="File of measured pulses.")]
Run = Annotated[Path, typer.Argument(help="Folder of a training run.", metavar="RUN")]
Seed = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of everything random.")]
Device = Annotated[str, typer.Option(help="cpu, cuda, or auto: the GPU if there is one.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing output.")]
SimTable = Annotated[
    str | None, typer.Option(help="Table of the simulated pulses, if the file has several.")
]
DataTable = Annotated[
    str | None, typer.Option(help="Table of the measured pulses, if the file has several.")
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
        help="Calibration of measured pulses without energies in keV: keV per ADC count."
    ),
]
Dt = Annotated[
    float | None,
    typer.Option("--dt-ns", "--dt", help="Sampling period in ns, if the files do not tell."),
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
    bool, typer.Option("--rivals/--no-rivals", help="Fit the rival methods too, or not.")
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
