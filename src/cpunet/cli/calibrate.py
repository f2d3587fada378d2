"""``cpunet calibrate``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.cli.values import parse_numbers
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs

if TYPE_CHECKING:
    from cpunet.jobs.calibration.calibration_inputs import Start
    from cpunet.simulation.hit_sources import HitFile

PHYSICS, HITS = "What is free", "Simulation"

Out = Annotated[
    Path | None, typer.Option("--out", help="Run folder to make; may be left out with --plan.")
]
SimFile = Annotated[
    Path | None,
    typer.Option(
        "--sim", help="Output of cpunet simulate or stand, with its hits.", rich_help_panel=HITS
    ),
]
DetectorFile = Annotated[
    str | None,
    typer.Option(
        "--detector",
        help="icpc, bege, ppc, a YAML file, a siggen configuration or LEGEND metadata; that of "
        "--sim by default.",
        rich_help_panel=HITS,
    ),
]
HitFileName = Annotated[
    Path | None,
    typer.Option(
        "--hits",
        help="Hits to simulate, as for cpunet simulate, instead of --sim.",
        rich_help_panel=HITS,
    ),
]
ClusterMm = Annotated[
    float,
    typer.Option(
        callback=options.within(0, 100),
        help="Of --hits: merge those nearer than this. Self-repulsion acts in what is merged.",
        rich_help_panel=HITS,
    ),
]
SettingsFile = Annotated[
    Path | None,
    typer.Option(
        "--settings",
        help="YAML file of the simulation's settings; those of --sim by default.",
        rich_help_panel=HITS,
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Override a value of the detector or of the settings (repeatable).",
        rich_help_panel=HITS,
    ),
]
Free = Annotated[
    str,
    typer.Option(
        help="Parameters, as temperature,impurity; auto: those that the data tell.",
        rich_help_panel=PHYSICS,
    ),
]
Fix = Annotated[
    str,
    typer.Option(help="Parameters that stay as simulated.", rich_help_panel=PHYSICS),
]
PriorText = Annotated[
    list[str] | None,
    typer.Option(
        "--prior",
        help="NAME=VALUE±ERROR (or +-) of a parameter or of depletion_voltage (repeatable).",
        rich_help_panel=PHYSICS,
    ),
]
Plan = Annotated[
    bool,
    typer.Option(
        "--plan", help="Only tell what these pulses know of the physics, before any fit."
    ),
]
Peak = Annotated[
    str, typer.Option(help="Energies to calibrate on: FEP, SEP, DEP or ranges in keV.")
]
RecipeName = Annotated[str, typer.Option("--recipe", help="fast, or a YAML file of your own.")]
Events = Annotated[
    int,
    typer.Option(
        min=200,
        max=10_000_000,
        help="Simulated events, at most, that are drifted again and again.",
    ),
]

HitTable = Annotated[
    str | None,
    typer.Option(
        "--hits-detector", help="Which of the file's detectors.", rich_help_panel=HITS
    ),
]
Origin = Annotated[
    str | None,
    typer.Option(
        help="X,Y,Z in mm: the point contact's centre in the file's frame.",
        rich_help_panel=HITS,
    ),
]
FlipZ = Annotated[
    bool,
    typer.Option("--flip-z", help="The file's point contact is on top.", rich_help_panel=HITS),
]
LengthUnit = Annotated[
    str | None, typer.Option(help="If the file names none.", rich_help_panel=HITS)
]
EnergyUnit = Annotated[
    str | None, typer.Option(help="If the file names none.", rich_help_panel=HITS)
]


@dataclass(frozen=True)
class HitFrame:
    """How a file of hits is read."""

    hits_detector: HitTable = None
    origin: Origin = None
    flip_z: FlipZ = False
    length_unit: LengthUnit = None
    energy_unit: EnergyUnit = None

    def file(self, hits: Path) -> HitFile:
        """The file."""
        from cpunet.simulation.hit_readers import Transform
        from cpunet.simulation.hit_sources import HitFile

        x, y, z = parse_numbers("0,0,0" if self.origin is None else self.origin, 3, "--origin")
        transform = Transform((x, y, z), self.flip_z)
        units = self.length_unit, self.energy_unit
        return HitFile(hits, self.hits_detector, transform, *units)


@options.grouped
def calibrate(
    *,
    data: options.Data,
    out_folder: Out = None,
    sim: SimFile = None,
    detector: DetectorFile = None,
    hits: HitFileName = None,
    frame: HitFrame,
    cluster_mm: ClusterMm = 0.2,
    settings_file: SettingsFile = None,
    set_values: Set = None,
    crystal: options.Crystal = None,
    free: Free = "auto",
    fix: Fix = "",
    prior: PriorText = None,
    plan: Plan = False,
    peak: Peak = "FEP",
    recipe: RecipeName = "fast",
    events: Events = 3000,
    seed: options.Seed = 0,
    read_as: options.DataAs,
    force: options.Force = False,
) -> None:
    """Calibrate the detector and its electronics together: temperature, impurities, readout.

    Example: cpunet calibrate --sim sim.lh5 --data raw.lh5 --out run

    Example: cpunet calibrate --detector V01.yaml --hits stp.lh5 --data raw.lh5 --out run \
--free temperature,impurity --prior depletion_voltage=2100±50

    Example: cpunet calibrate --sim sim.lh5 --data raw.lh5 --plan
    """
    from cpunet.jobs.calibration.calibrate import Calibration
    from cpunet.jobs.calibration.calibration_inputs import Freedom
    from cpunet.pulses.channels import ALL
    from cpunet.recipes import load_recipe

    if read_as.data_table == ALL:
        raise CpunetError(
            f"--data-table {ALL}: each channel is a detector with physics of its own; calibrate"
            " one after another, with --data-table CHANNEL and the --sim or --detector of each"
        )
    if out_folder is None and not plan:
        raise CpunetError("give --out, the run folder to make, or --plan")
    if out_folder is not None:
        refuse_inputs(out_folder, recipe, detector, crystal, settings_file)
    start = _start(
        sim, detector, hits, settings_file, set_values or [], crystal, frame,
        cluster_mm, read_as.insist,
    )  # fmt: skip
    measured = read_as.data(data)
    job = Calibration(
        start,
        measured,
        load_recipe(recipe),
        Freedom.of(free, fix, prior or []),
        peak=peak,
        events=events,
        seed=seed,
    )
    if plan:
        for line in plan_lines(job.plan(out_folder, force=force)):
            tell(line)
        return
    assert out_folder is not None
    content = job.run(out_folder, force=force)
    for line in result_lines(content):
        tell(f"{out_folder}: {line}")


def _start(
    sim: Path | None,
    detector: str | None,
    hits: Path | None,
    settings_file: Path | None,
    overrides: list[str],
    crystal: Path | None,
    frame: HitFrame,
    cluster_mm: float,
    insist: bool,
) -> Start:
    from cpunet.jobs.calibration.calibration_inputs import Start
    from cpunet.pulses.reading.files import PulseFile
    from cpunet.settings import read_settings
    from cpunet.simulation.geometry_readers import read_detector
    from cpunet.simulation.settings import SimulationSettings, split_overrides

    of_detector, of_settings = split_overrides(overrides)
    if of_detector and detector is None:
        raise CpunetError(f"--set {next(iter(of_detector))}: give the --detector that it is of")
    given = settings_file is not None or of_settings
    return Start(
        None if sim is None else PulseFile(sim, insist=insist),
        None if hits is None else frame.file(hits),
        None if detector is None else read_detector(detector, of_detector, crystal),
        read_settings(SimulationSettings, settings_file, of_settings) if given else None,
        cluster_mm,
    )


def result_lines(content: dict[str, Any]) -> list[str]:
    """What a calibration has found, a line each."""
    from cpunet.calibration.titles import titled

    chi = content["chi_square"]
    before, after = chi["before"] / chi["moments"], chi["after"] / chi["moments"]
    lines = [
        f"{titled(name)} {told['value']:.5g} ± {told['error']:.2g} (simulated with "
        f"{told['simulated']:.5g}; ± {told['error_all']:.2g} if all physics were free)"
        for name, told in content["parameters"].items()
    ]
    fixed = ", ".join(
        f"{titled(name)} (chi-square would fall by {told['chi_square_would_fall_by']:.1f})"
        for name, told in content["fixed"].items()
    )
    return [
        *(lines or ["no parameter of the physics is determined better than it was known"]),
        *([f"left as simulated: {fixed}"] if fixed else []),
        f"chi-square per function {before:.2f} before, {after:.2f} after; see pulls.png",
    ]


def plan_lines(content: dict[str, Any]) -> list[str]:
    """A plan as a table: errors alone and with all free, by number of pulses."""
    from cpunet.calibration.titles import titled

    pulses = [str(n) for n in content["pulses"]]
    alone = "error of one alone"
    width = max(map(len, [alone, *map(titled, content["errors"])]))
    head = "".join(f"{'N=' + n:>12}" for n in pulses)
    lines = [f"{alone:<{width}}{'prior':>10}{head}"]
    for kind in ("alone", "all_free"):
        if kind == "all_free":
            lines.append(f"{'with all free':<{width}}{'prior':>10}{head}")
        for name, told in content["errors"].items():
            cells = "".join(f"{told[kind][n]:>12.3g}" for n in pulses)
            lines.append(f"{titled(name):<{width}}{told['prior']:>10.3g}{cells}")
    middle = pulses[len(pulses) // 2]
    lines.append(f"directions with {middle} pulses of each side, error in units of the prior:")
    lines += [
        f"{d['error']:8.3f}  {titled(d['words'], units=False)}"
        for d in content["directions"][middle]
    ]
    return lines
