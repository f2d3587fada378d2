"""``cpunet stand``."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs

if TYPE_CHECKING:
    from cpunet.electronics.chain import Hum, Wander
    from cpunet.jobs.simulation.stand import StandSummary


Part = TypeVar("Part")


class Kind(StrEnum):
    """Whether the data's detector is the simulated one."""

    matched = "matched"
    shifted = "shifted"


Preset = Annotated[
    str, typer.Option("--preset", help="Readout: ornl, legend200, ringing, or a YAML file.")
]
Out = Annotated[Path, typer.Option("--out", help="Folder to make.")]
Events = Annotated[
    str, typer.Option(help="Events of each peak or range (keV), for sim and data each.")
]
KindOption = Annotated[
    Kind, typer.Option("--kind", help="shifted: the data's detector differs a little.")
]
ShiftParts = Annotated[
    list[str] | None,
    typer.Option(
        "--shift",
        help="By what a shifted stand's data differ, instead of the default: "
        "temperature_K=1.5, or a YAML file of keys (repeatable).",
    ),
]
SetValues = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="Override a value of the detector or of the settings (repeatable)."
    ),
]
RateKhz = Annotated[
    float | None,
    typer.Option(
        "--rate-khz",
        help="Pulses per ms before a record; their tails are under it.",
        callback=options.within(0, 1000),
    ),
]
PileUpKhz = Annotated[
    float | None,
    typer.Option(
        "--pile-up-khz",
        help="Pulses per ms within a record besides its own.",
        callback=options.within(0, 1000),
    ),
]
HumOption = Annotated[
    str | None, typer.Option("--hum", help="Wave of the mains: HZ=KEV, such as 50=2.")
]
WanderOption = Annotated[
    str | None,
    typer.Option("--wander", help="Slow wandering of the baseline: US=KEV, such as 500=3."),
]
WindowKev = Annotated[
    float,
    typer.Option(help="Half-width about a peak.", callback=options.within(-1e4, 1e4)),
]


def stand(
    preset: Preset,
    out_folder: Out,
    detector: options.DetectorFile = "icpc",
    events: Events = "FEP=4000,SEP=1500,DEP=1500",
    kind: KindOption = Kind.matched,
    shift: ShiftParts = None,
    set_values: SetValues = None,
    settings_file: options.SettingsFile = None,
    crystal: options.Crystal = None,
    rate_khz: RateKhz = None,
    pile_up_khz: PileUpKhz = None,
    hum: HumOption = None,
    wander: WanderOption = None,
    window_kev: WindowKev = 0.5,
    seed: options.Seed = 0,
    force: options.Force = False,
) -> None:
    """Make a test stand: simulated pulses, raw traces of other events, and the truth.

    Example: cpunet stand --preset legend200 --out stand

    Example: cpunet stand --preset ornl --rate-khz 3 --out busy

    Example: cpunet stand --preset ornl --kind shifted --shift bias_V=20 --out stand2
    """
    from cpunet.electronics.chain import read_electronics
    from cpunet.jobs.simulation.stand import make_stand
    from cpunet.recipes import load_recipe
    from cpunet.settings import read_settings
    from cpunet.simulation.energy_windows import wanted_events
    from cpunet.simulation.geometry_readers import read_detector
    from cpunet.simulation.settings import SimulationSettings, split_overrides
    from cpunet.simulation.shifted import Shift

    refuse_inputs(out_folder, preset, detector, crystal, settings_file, *(shift or ()))
    wanted = wanted_events(events, load_recipe("fast").peaks, window_kev)
    overrides, values = split_overrides(set_values or ())
    electronics = read_electronics(preset).disturbed(
        rate_khz, pile_up_khz, wanted_hum(hum), wanted_wander(wander)
    )
    summary = make_stand(
        electronics,
        read_detector(detector, overrides, crystal),
        tuple(wanted),
        tuple(wanted.values()),
        out_folder,
        kind=kind.value,
        shift=Shift.of(shift) if shift else None,
        settings=read_settings(SimulationSettings, settings_file, values),
        seed=seed,
        force=force,
    )
    for line in _lines(summary):
        tell(f"{out_folder}: {line}")


def wanted_hum(hum: str | None) -> Hum | None:
    """The wave of ``"50=2"``: 2 keV at 50 Hz."""
    from cpunet.electronics.chain import Hum

    return _pair(hum, Hum, ("frequency_Hz", "amplitude_kev"), "--hum", "HZ=KEV, such as 50=2")


def wanted_wander(wander: str | None) -> Wander | None:
    """The wandering of ``"500=3"``: 3 keV RMS, correlated over 500 us."""
    from cpunet.electronics.chain import Wander

    form = "US=KEV, such as 500=3"
    return _pair(wander, Wander, ("time_us", "rms_kev"), "--wander", form)


def _pair(
    text: str | None, kind: Callable[..., Part], names: tuple[str, str], option: str, form: str
) -> Part | None:
    if text is None:
        return None
    try:
        return kind(**dict(zip(names, map(float, text.split("=")), strict=True)))
    except ValueError as error:
        raise CpunetError(f"{option} {text}: expected {form}") from error


def _lines(summary: StandSummary) -> list[str]:
    def told(counts: dict[str, int]) -> str:
        return ", ".join(f"{n} {name}" for name, n in counts.items())

    return [
        f"sim.lh5: {summary.n_sim} pulses ({told(summary.sim_lines)}), with truth.npz",
        f"data.lh5: {summary.n_data} traces ({told(summary.data_lines)}); "
        f"{told(summary.flags)}",
    ]
