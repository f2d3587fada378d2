"""Options that several commands share."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

if TYPE_CHECKING:
    from cpunet.pulses.reading.files import PulseFile
    from cpunet.recipes.schema import Recipe

# Far beyond what anyone needs, and what a job can hold or live to see.
MAX_SAMPLES = 1 << 20
MAX_REALISATIONS = 10_000
MAX_THREADS = 1024


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


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command take options together: a parameter of a dataclass stands for its fields.

    Typer sees the fields as options of the command, in the place of that parameter.
    """
    groups: dict[str, Any] = {}
    parameters = []
    hints = get_type_hints(command, include_extras=True)
    for given in inspect.signature(command).parameters.values():
        kind = hints[given.name]
        if not is_dataclass(kind):
            parameters.append(given.replace(annotation=kind))
            continue
        groups[given.name] = kind
        of_fields = get_type_hints(kind, include_extras=True)
        parameters += [
            inspect.Parameter(
                field.name,
                given.KEYWORD_ONLY,
                default=field.default,
                annotation=of_fields[field.name],
            )
            for field in fields(kind)
        ]

    @wraps(command)
    def expanded(**values: Any) -> None:
        for name, kind in groups.items():
            values[name] = kind(**{f.name: values.pop(f.name) for f in fields(kind)})
        command(**values)

    vars(expanded)["__signature__"] = inspect.Signature(parameters)
    expanded.__annotations__ = {given.name: given.annotation for given in parameters}
    return expanded


Sim = Annotated[Path, typer.Option("--sim", help="File of simulated pulses.")]
Data = Annotated[Path, typer.Option("--data", help="File of measured pulses.")]
Run = Annotated[Path, typer.Argument(help="Folder of a training run.", metavar="RUN")]
Runs = Annotated[
    list[Path], typer.Argument(help="Folders of training runs, as of several seeds.")
]
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
Energy = Annotated[str | None, typer.Option(help="Energy column, or FILE:path/to/column.")]
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
Inverse = Annotated[bool, typer.Option("--inverse", help="IREN: data → simulation-like.")]
Truth = Annotated[
    Path | None, typer.Option(help="Noise-free responses of the simulated pulses (.npz).")
]
Baselines = Annotated[
    bool,
    typer.Option("--baselines/--no-baselines", help="Fit the baseline methods too, or not."),
]
OldBaselines = Annotated[  # the old spelling, until 0.2
    bool | None, typer.Option("--rivals/--no-rivals", hidden=True)
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
Set = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override a detector's value: --set bias_V=3500 (repeatable)."),
]
SettingsFile = Annotated[
    Path | None, typer.Option("--settings", help="YAML file of settings of the simulation.")
]
DetectorFile = Annotated[
    str,
    typer.Option(
        "--detector",
        help="icpc, bege, ppc, a YAML file, a siggen configuration or LEGEND metadata.",
    ),
]
Peak = Annotated[
    str, typer.Option(help="Energies to train on: FEP, SEP, DEP or a range in keV, as 300-.")
]
RecipeName = Annotated[
    str,
    typer.Option("--recipe", help="fast, paper, or a YAML file of your own."),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override a value: --set training.batch_size=64 (repeatable)."),
]


@dataclass(frozen=True)
class DataAs:
    """How a file of measured pulses is read."""

    data_table: DataTable = None
    data_energy: DataEnergy = None
    kev_per_adc: KevPerAdc = None
    dt: Dt = None
    insist: Insist = False

    def data(self, path: Path) -> PulseFile:
        """The measured file."""
        from cpunet.pulses.reading.files import PulseFile

        return PulseFile(
            path, self.data_table, self.data_energy, self.kev_per_adc, self.dt, self.insist
        )


@dataclass(frozen=True)
class SimAs:
    """Where simulated pulses and their energies are in their file."""

    sim_table: SimTable = None
    sim_energy: SimEnergy = None


@dataclass(frozen=True)
class ReadAs(DataAs, SimAs):
    """How the files of both sides are read."""

    def sim(self, path: Path) -> PulseFile:
        """The simulated file."""
        from cpunet.pulses.reading.files import PulseFile

        return PulseFile(
            path, self.sim_table, self.sim_energy, dt_ns=self.dt, insist=self.insist
        )


@dataclass(frozen=True)
class ReadAsOrAll(ReadAs):
    """The same, where all channels may be asked for."""

    data_table: OneTableOrAll = None


@dataclass(frozen=True)
class ScoredWith:
    """What a validation compares with."""

    truth: Truth = None
    baselines: Baselines = True
    rivals: OldBaselines = None

    @property
    def fitted(self) -> bool:
        """Whether baseline methods are fitted, by either spelling."""
        return self.baselines if self.rivals is None else self.rivals


@dataclass(frozen=True)
class TrainOn:
    """The recipe of a training, and its energies."""

    recipe: RecipeName = "fast"
    peak: Peak = "FEP"
    set_values: Overrides = None

    def load(self) -> Recipe:
        """The recipe, with its values overridden."""
        from cpunet.recipes import load_recipe

        return load_recipe(self.recipe, self.set_values or ())
