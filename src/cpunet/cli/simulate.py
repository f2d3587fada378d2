"""``cpunet simulate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.cli.values import parse_events, parse_numbers, parse_resolution
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs

if TYPE_CHECKING:
    from cpunet.jobs.simulation.hit_sources import HitFile, HitSource, Window
    from cpunet.jobs.simulation.simulation_summary import Summary

HITS, GAMMAS = "Hits from a file", "Hits from the built-in gamma Monte Carlo"
PULSES, OUTPUT = "Pulses", "Output"

Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Override a value of the detector or of the settings: --set bias_V=3500 "
        "(repeatable).",
    ),
]
Temperature = Annotated[
    float | None, typer.Option("--temperature", help="Of the crystal in K; the detector's own.")
]
Out = Annotated[Path, typer.Option("--out", help="LH5 file to write.", rich_help_panel=OUTPUT)]
HitFileName = Annotated[
    Path | None,
    typer.Option(
        "--hits",
        help="remage LH5, g4simple or Geant4 CSV/HDF5, NPZ, or an earlier output.",
        rich_help_panel=HITS,
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
TimeWindowUs = Annotated[
    float,
    typer.Option(
        help="Hits of an event number that come later than this are another event.",
        rich_help_panel=HITS,
        callback=options.within(0, 1e12),
    ),
]
Events = Annotated[
    str | None,
    typer.Option(
        help="N events of each peak, or FEP=10000,SEP=3000,1500-1580=500 (keV).",
        rich_help_panel=GAMMAS,
    ),
]
Peak = Annotated[
    str | None,
    typer.Option(
        help="FEP,SEP,DEP or ranges in keV; with --hits, only these events (else all).",
        show_default="FEP,SEP,DEP",
    ),
]
WindowKev = Annotated[
    float,
    typer.Option(
        help="Half-width about a peak; wider ones bring the continuum with them.",
        callback=options.within(-1e4, 1e4),
    ),
]
SourceHeight = Annotated[
    float,
    typer.Option(
        help="Of the source above the crystal, mm.",
        rich_help_panel=GAMMAS,
        callback=options.within(-1e4, 1e4),
    ),
]
SourceRadius = Annotated[
    float,
    typer.Option(
        help="Of the source, a disc, mm.",
        rich_help_panel=GAMMAS,
        callback=options.within(0, 1e4),
    ),
]
Exact = Annotated[
    bool | None,
    typer.Option(
        "--exact/--library",
        help="Drift every hit, or interpolate between pulses of a grid (for many hits).",
        show_default="exact below 200,000 hits",
        rich_help_panel=PULSES,
    ),
]
ClusterMm = Annotated[
    float,
    typer.Option(
        callback=options.within(0, 100),
        help="Merge hits nearer than this. Charge repels within what is merged.",
        rich_help_panel=PULSES,
    ),
]
ResolutionText = Annotated[
    str | None,
    typer.Option(
        "--resolution",
        help="A,B: smear the energies written, FWHM² = A + B E in keV, as 0.5,0.0018.",
        rich_help_panel=PULSES,
    ),
]
SettingsFile = Annotated[
    Path | None,
    typer.Option("--settings", help="YAML file of all settings.", rich_help_panel=PULSES),
]
Dt = Annotated[
    float | None,
    typer.Option(
        "--dt-ns", "--dt", help="Sampling period.", show_default="16", rich_help_panel=PULSES
    ),
]
Length = Annotated[
    float | None,
    typer.Option(
        "--length-ns",
        "--length",
        help="Length of the pulses.",
        show_default="3600",
        rich_help_panel=PULSES,
    ),
]
Diffusion = Annotated[
    bool | None,
    typer.Option(
        "--diffusion/--no-diffusion", show_default="diffusion", rich_help_panel=PULSES
    ),
]
DiffusionConstant = Annotated[
    str | None,
    typer.Option(
        help="D/(v/E) in V mm/cm, temperature (kT/e, 0.078 at 90 K) or siggen (with its "
        "roundings).",
        show_default="0.12",
        rich_help_panel=PULSES,
    ),
]
CloudFwhm = Annotated[
    float | None,
    typer.Option(
        help="Width of the charge cloud at first.", show_default="0.1", rich_help_panel=PULSES
    ),
]
SelfRepulsion = Annotated[
    bool | None,
    typer.Option(
        "--self-repulsion/--no-self-repulsion",
        show_default="no-self-repulsion",
        rich_help_panel=PULSES,
    ),
]


@dataclass(frozen=True)
class HitFrame:
    """How a file of hits is read."""

    hits_detector: HitTable = None
    origin: Origin = None
    flip_z: FlipZ = False
    length_unit: LengthUnit = None
    energy_unit: EnergyUnit = None
    time_window_us: TimeWindowUs = 10.0

    def file(self, hits: Path, windows: Sequence[Window] = ()) -> HitFile:
        """The file, of which only events in `windows` are wanted if there are any."""
        from cpunet.jobs.simulation.hit_sources import HitFile
        from cpunet.simulation.hit_readers import Transform

        x, y, z = parse_numbers("0,0,0" if self.origin is None else self.origin, 3, "--origin")
        transform = Transform((x, y, z), self.flip_z)
        units = self.length_unit, self.energy_unit
        return HitFile(
            hits,
            self.hits_detector,
            transform,
            *units,
            tuple(windows),
            time_window_us=self.time_window_us,
        )


@options.grouped
def simulate(
    *,
    detector: options.DetectorFile,
    out_file: Out,
    hits: HitFileName = None,
    events: Events = None,
    peak: Peak = None,
    window_kev: WindowKev = 0.5,
    set_values: Set = None,
    crystal: options.Crystal = None,
    impurity_from: options.ImpurityFrom = options.Impurities.file,
    temperature: Temperature = None,
    frame: HitFrame,
    source_height_mm: SourceHeight = 20.0,
    source_radius_mm: SourceRadius = 5.0,
    settings_file: SettingsFile = None,
    dt: Dt = None,
    length: Length = None,
    diffusion: Diffusion = None,
    diffusion_constant: DiffusionConstant = None,
    cloud_fwhm_mm: CloudFwhm = None,
    self_repulsion: SelfRepulsion = None,
    exact: Exact = None,
    cluster_mm: ClusterMm = 0.2,
    resolution: ResolutionText = None,
    seed: options.Seed = 0,
    force: options.Force = False,
) -> None:
    """Simulate pulses of a detector, from hits of a file or of Tl-208 gammas.

    Example: cpunet simulate --detector icpc --events FEP=10000,DEP=3000 --out sim.lh5

    Example: cpunet simulate --detector V01.yaml --hits stp.lh5 --flip-z --out sim.lh5
    """
    from cpunet.jobs.simulation.hit_sources import GammaSource, energy_windows
    from cpunet.jobs.simulation.simulate import simulate_file
    from cpunet.recipes import load_recipe
    from cpunet.settings import read_settings
    from cpunet.simulation.geometry_readers import read_detector
    from cpunet.simulation.settings import SimulationSettings, split_overrides

    if (hits is None) == (events is None):
        raise CpunetError(
            "give either --hits FILE or --events N (for the gamma Monte Carlo); pulse-shape "
            "libraries are made by cpunet library make"
        )
    refuse_inputs(out_file, detector, crystal, settings_file)
    peaks = load_recipe("fast").peaks
    source: HitSource
    if hits is not None:
        chosen = energy_windows(peak, peaks, window_kev) if peak else []
        source = frame.file(hits, chosen)
    else:
        chosen, wanted = parse_events(str(events), peak, peaks, window_kev)
        source = GammaSource(tuple(chosen), wanted, source_height_mm, source_radius_mm, seed)
    overrides, set_settings = split_overrides(set_values or ())
    if temperature is not None:
        overrides["temperature_K"] = temperature
    options_given = {
        "dt_ns": dt,
        "length_ns": length,
        "diffusion": diffusion,
        "diffusion_constant": diffusion_constant,
        "cloud_fwhm_mm": cloud_fwhm_mm,
        "self_repulsion": self_repulsion,
    }
    values = set_settings | {k: v for k, v in options_given.items() if v is not None}
    summary = simulate_file(
        read_detector(detector, overrides, crystal),
        source,
        out_file,
        read_settings(SimulationSettings, settings_file, values),
        impurity_from=impurity_from.value,
        windows=tuple(chosen or energy_windows(",".join(peaks), peaks, window_kev)),
        mode="auto" if exact is None else "exact" if exact else "library",
        cluster_mm=cluster_mm,
        resolution=parse_resolution(resolution),
        seed=seed,
        force=force,
    )
    for line in summary_lines(summary):
        tell(f"{out_file}: {line}")


def summary_lines(summary: Summary) -> list[str]:
    """The summary of a simulation in words, for stdout."""
    seconds = sum(summary.seconds.values())
    spent = ", ".join(f"{name} {s:.1f}" for name, s in summary.seconds.items())
    lines = ", ".join(f"{n} {name}" for name, n in summary.lines.items())
    told = [
        f"{summary.n_written} of {summary.n_events} events written ({lines} by collected "
        f"energy); {summary.without_signal} without any signal",
        f"{summary.hits} hits ({summary.hits_before_merging} before merging): "
        f"{summary.hits_in_contacts} in contacts and the lithium layer, "
        f"{summary.hits_outside} outside the crystal",
        f"{summary.lost_kev / summary.energy_kev:.2%} of the energy lost there, in "
        f"{summary.events_with_loss} events",
        f"{summary.mode} pulses, {summary.n_events / seconds:.0f} events/s, "
        f"{seconds:.1f} s: {spent}",
    ]
    if summary.trapped_kev:
        told.insert(3, f"{summary.trapped_kev / summary.energy_kev:.2%} of the energy trapped")
    if summary.not_collected:
        told.insert(3, f"{summary.not_collected} hits not collected in full; lengthen --length")
    return told
