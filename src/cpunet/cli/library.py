"""``cpunet library``: pulse-shape libraries for production simulations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, tell
from cpunet.cli.values import parse_numbers
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs

library = typer.Typer(
    help="Make pulse-shape libraries, and put them behind the learned electronics.",
    no_args_is_help=True,
)

DetectorFile = Annotated[
    str,
    typer.Option(
        "--detector",
        help="icpc, bege, ppc, a YAML file, a siggen configuration or LEGEND metadata.",
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override a detector's value: --set bias_V=3500 (repeatable)."),
]
Out = Annotated[Path, typer.Option("--out", help="LH5 file to write.")]
Source = Annotated[Path, typer.Argument(help="LH5 file of a library.", metavar="FILE")]
Grid = Annotated[
    float,
    typer.Option(
        "--grid-mm",
        help="Spacing of the places in r and z.",
        callback=options.within(0.01, 100),
    ),
]
Angles = Annotated[str, typer.Option(help="Azimuths from <100> in degrees.")]
Dt = Annotated[
    float | None, typer.Option("--dt-ns", "--dt", help="Sampling period in ns; 1 by default.")
]
Length = Annotated[
    float | None, typer.Option("--length-ns", help="Length of a template; 5000 by default.")
]
Currents = Annotated[
    bool,
    typer.Option("--currents", help="Write aligned currents, for reboost's A/E."),
]
SettingsFile = Annotated[
    Path | None, typer.Option("--settings", help="Settings of the simulation, a YAML file.")
]


@library.command()
def make(
    detector: DetectorFile,
    out_file: Out,
    grid_mm: Grid = 1.0,
    angles: Angles = "0,45",
    dt: Dt = None,
    length_ns: Length = None,
    settings: SettingsFile = None,
    set_values: Set = None,
    crystal: options.Crystal = None,
    force: options.Force = False,
) -> None:
    """Simulate the charge pulse of every place in a detector.

    Example: cpunet library make --detector icpc --out psl.lh5
    """
    from cpunet.jobs.simulation.pulse_shape_library import DT_NS, LENGTH_NS, write_library
    from cpunet.jobs.simulation.simulation_settings import load_settings
    from cpunet.simulation.geometry_readers import read_detector

    refuse_inputs(out_file, detector, settings)
    degrees = parse_numbers(angles, angles.count(",") + 1, "--angles")
    if any(angle != int(angle) for angle in degrees):
        raise CpunetError(f"--angles {angles}: give whole degrees")
    if settings is None:
        dt, length_ns = dt or DT_NS, length_ns or LENGTH_NS
    counts = write_library(
        read_detector(detector, set_values or (), crystal),
        out_file,
        settings=load_settings(settings, {"dt_ns": dt, "length_ns": length_ns}),
        grid_mm=grid_mm,
        angles_deg=tuple(map(int, degrees)),
        force=force,
        monitor=monitor(),
    )
    tell(
        f"{out_file}: {counts['written']} of {counts['templates']} places have a template; "
        f"{counts['outside']} give no signal, {counts['late']} are not collected in time",
        soft_wrap=True,
    )


@library.command()
def translate(
    run: options.Run,
    source: Source,
    out_file: Out,
    currents: Currents = False,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Translate a library of charge pulses with a trained run, without noise.

    Example: cpunet library translate run psl.lh5 --out psl_ren.lh5
    """
    from cpunet.jobs.translation.translate_library import translate_library

    told = translate_library(
        run,
        source,
        out_file,
        currents=currents,
        device=device,
        force=force,
        monitor=monitor(),
    )
    rejected = "".join(f", {n} {reason}" for reason, n in told["rejections"].items())
    tell(
        f"{out_file}: {told['translated']} of {told['templates']} templates translated; "
        f"{told['outside']} outside{rejected}",
        soft_wrap=True,
    )
    apart = told["linearity"]
    tell(
        f"sums of {apart['events']} events: sample by sample within {apart['largest']:.1e} of "
        f"the highest, current amplitude within {apart['current_amplitude']:.1e} of itself",
        soft_wrap=True,
    )
