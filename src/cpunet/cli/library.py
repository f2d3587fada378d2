"""``cpunet library``: pulse-shape libraries for production simulations."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.cli.values import parse_numbers
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs

RINGS = 3

library = typer.Typer(
    help="Make pulse-shape libraries, and put them behind the learned electronics.",
    no_args_is_help=True,
)

Out = Annotated[Path, typer.Option("--out", help="LH5 file to write.")]
Source = Annotated[Path, typer.Argument(help="LH5 file of a library.", metavar="FILE")]
Sources = Annotated[
    list[Path], typer.Argument(help="LH5 files of realistic libraries.", metavar="FILE...")
]
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


class Form(StrEnum):
    """Layouts of a translated library."""

    charge = "charge"
    simflow = "simflow"


FormName = Annotated[
    Form,
    typer.Option(
        "--format",
        help="charge: as it was given. simflow: currents as LEGEND's production reads them.",
    ),
]
LowRank = Annotated[
    int | None,
    typer.Option(
        "--low-rank",
        help="With simflow: number of components in place of whole templates.",
        min=1,
        max=1000,
    ),
]
Rings = Annotated[
    int,
    typer.Option(
        "--rings",
        help="With simflow: of nodes beyond the crystal; 3 as production.",
        min=0,
        max=100,
    ),
]
Names = Annotated[
    list[str] | None,
    typer.Option(
        "--detector", help="With simflow: library of the file to translate (repeatable)."
    ),
]
Thickness = Annotated[
    float,
    typer.Option(
        "--thickness-mm",
        help="From the surface to where all charge is collected.",
        callback=options.within(0, 10, above=True),
    ),
]
Recombination = Annotated[
    float,
    typer.Option(
        "--recombination-mm", help="How deep charge recombines.", callback=options.within(0, 10)
    ),
]
Lifetime = Annotated[
    float,
    typer.Option(
        "--lifetime-ns",
        help="Of charge where it recombines.",
        callback=options.within(1, 1e9),
    ),
]
Diffusion = Annotated[
    float,
    typer.Option(
        "--diffusion-cm2-per-s",
        help="Constant of the holes' diffusion.",
        callback=options.within(1, 1e5),
    ),
]


@library.command()
def make(
    detector: options.DetectorFile,
    out_file: Out,
    grid_mm: Grid = 1.0,
    angles: Angles = "0,45",
    dt: Dt = None,
    length_ns: Length = None,
    settings: options.SettingsFile = None,
    set_values: options.Set = None,
    crystal: options.Crystal = None,
    force: options.Force = False,
) -> None:
    """Simulate the charge pulse of every place in a detector.

    Example: cpunet library make --detector icpc --out psl.lh5
    """
    from cpunet.jobs.simulation.pulse_shape_library import DT_NS, LENGTH_NS, write_library
    from cpunet.settings import read_settings
    from cpunet.simulation.geometry_readers import read_detector
    from cpunet.simulation.settings import SimulationSettings

    refuse_inputs(out_file, detector, crystal, settings)
    degrees = parse_numbers(angles, angles.count(",") + 1, "--angles")
    if any(angle != int(angle) for angle in degrees):
        raise CpunetError(f"--angles {angles}: give whole degrees")
    if settings is None:
        dt = DT_NS if dt is None else dt
        length_ns = LENGTH_NS if length_ns is None else length_ns
    given = {"dt_ns": dt, "length_ns": length_ns}
    counts = write_library(
        read_detector(detector, set_values or (), crystal),
        out_file,
        settings=read_settings(
            SimulationSettings, settings, {k: v for k, v in given.items() if v is not None}
        ),
        grid_mm=grid_mm,
        angles_deg=tuple(map(int, degrees)),
        force=force,
    )
    tell(
        f"{out_file}: {counts['written']} of {counts['templates']} places have a template; "
        f"{counts['outside']} give no signal, {counts['late']} are not collected in time"
    )


@library.command()
def translate(
    run: options.Run,
    source: Source,
    out_file: Out,
    currents: Currents = False,
    form: FormName = Form.charge,
    low_rank: LowRank = None,
    rings: Rings = RINGS,
    detectors: Names = None,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Translate a library of charge pulses with a trained run, without noise.

    Example: cpunet library translate run psl.lh5 --out psl_ren.lh5
    """
    if form is Form.simflow:
        if currents:
            raise CpunetError("--format simflow holds currents already; leave out --currents")
        _for_simflow(
            run, source, out_file, low_rank, rings, detectors, device=device, force=force
        )
        return
    if low_rank is not None or detectors or rings != RINGS:
        raise CpunetError(
            "--low-rank, --rings and --detector are those of --format simflow; add it"
        )
    from cpunet.jobs.translation.translate_library import translate_library

    told = translate_library(
        run,
        source,
        out_file,
        currents=currents,
        device=device,
        force=force,
    )
    rejected = "".join(f", {n} {reason}" for reason, n in told["rejections"].items())
    tell(
        f"{out_file}: {told['translated']} of {told['templates']} templates translated; "
        f"{told['outside']} outside{rejected}"
    )
    apart = told["linearity"]
    tell(
        f"sums of {apart['events']} events: sample by sample within {apart['largest']:.1e} of "
        f"the highest, current amplitude within {apart['current_amplitude']:.1e} of itself"
    )


@library.command()
def merge(sources: Sources, out_file: Out, force: options.Force = False) -> None:
    """Put realistic libraries of several detectors into one file.

    Example: cpunet library merge V01.lh5 V02.lh5 --out psl.lh5
    """
    from cpunet.jobs.translation.simflow_files import merge_libraries

    names = merge_libraries(sources, out_file, force=force)
    tell(f"{out_file}: {len(names)} libraries: {', '.join(names)}")


@library.command()
def expand(source: Source, out_file: Out, force: options.Force = False) -> None:
    """Make whole templates of a library of components (--low-rank), for reboost.

    Example: cpunet library expand psl_small.lh5 --out psl.lh5
    """
    from cpunet.jobs.translation.simflow_files import expand_library

    names = expand_library(source, out_file, force=force)
    tell(f"{out_file}: whole templates of {', '.join(names)}")


@library.command()
def lithium(
    out_file: Out,
    thickness_mm: Thickness = 1.0,
    recombination_mm: Recombination = 0.5,
    lifetime_ns: Lifetime = 500.0,
    diffusion: Diffusion = 290.0,
    force: options.Force = False,
) -> None:
    """Tabulate the delayed charge of a lithium layer, for reboost's surface model.

    Example: cpunet library lithium --thickness-mm 1.0 --out lithium.lh5
    """
    from cpunet.jobs.translation.lithium_library import write_lithium_library
    from cpunet.simulation.lithium import LithiumLayer

    layer = LithiumLayer(thickness_mm, recombination_mm, lifetime_ns, diffusion)
    told = write_lithium_library(layer, out_file, force=force)
    tell(
        f"{out_file}: half of the charge from {told['dead_mm']:.2f} mm arrives, half of that "
        f"within {told['half_ns']:.0f} ns"
    )


def _for_simflow(
    run: Path,
    source: Path,
    out_file: Path,
    low_rank: int | None,
    rings: int,
    detectors: list[str] | None,
    **more: Any,
) -> None:
    from cpunet.jobs.translation.simflow_library import translate_for_simflow

    told = translate_for_simflow(
        run,
        source,
        out_file,
        detectors=detectors or (),
        rings=rings,
        rank=low_rank,
        **more,
    )
    for name, one in told.items():
        healed = f", {one['healed']} of them within it" if one["healed"] else ""
        tell(
            f"{out_file}: {name}: {one['translated']} of {one['templates']} templates "
            f"translated, {one['padded']} added about the crystal{healed}; "
            f"A/E is most often {one['mode_per_ns']:.4g}/ns"
        )
        if loss := one.get("loss"):
            tell(
                f"{one['rank']} components: samples within {loss['largest']:.1e} of the "
                f"most frequent A/E (RMS {loss['rms']:.1e}), A/E within "
                f"{loss['a_over_e_percent']:.2g} % (RMS "
                f"{loss['a_over_e_rms_percent']:.2g} %)"
            )
