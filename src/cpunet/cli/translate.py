"""``cpunet translate``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cpunet.cli import options
from cpunet.cli.channels import tell_channels
from cpunet.cli.messages import tell
from cpunet.errors import CpunetError

if TYPE_CHECKING:
    from cpunet.jobs.translation.translate_options import Adc

FILES, ADC = "Many files", "Raw traces in ADC counts (--output adc)"


class Output(StrEnum):
    """Forms of output."""

    NORMALISED = "normalised"
    ADC = "adc"


Sources = Annotated[
    list[Path],
    typer.Argument(
        help="Files of pulses to translate, or patterns as 'sim_*.lh5'.", metavar="FILE…"
    ),
]
Out = Annotated[
    str,
    typer.Option("--out", help="LH5 file to write; for several files, or with /, a folder."),
]
Noise = Annotated[
    bool, typer.Option("--noise/--no-noise", help="Add noise as the data have it, or none.")
]
Remains = Annotated[
    str,
    typer.Option(
        "--remains", help="Remains of earlier pulses: learned, none, or a rate in kHz."
    ),
]
PileUpKhz = Annotated[
    float,
    typer.Option("--pile-up-khz", min=0, help="Pulses per ms within a trace besides its own."),
]
Realisations = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=options.MAX_REALISATIONS,
        help="Number of noise draws for each pulse: rows are repeated and numbered.",
    ),
]
Table = Annotated[
    str | None, typer.Option(help="Table to read, if the file has several; or all.")
]
OutTable = Annotated[str | None, typer.Option(help="Table to write; geds/ren or geds/iren.")]
Jobs = Annotated[
    int,
    typer.Option(
        min=1,
        max=options.MAX_THREADS,
        help="Processes, a file each at a time.",
        rich_help_panel=FILES,
    ),
]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Skip what is there already, if made in the same way.",
        rich_help_panel=FILES,
    ),
]
AdcPerKev = Annotated[
    float | None,
    typer.Option(
        help="Maximum over the baseline, ADC counts per keV; that of the run's data.",
        callback=options.within(0, 1e9, above=True),
        rich_help_panel=ADC,
    ),
]
Baseline = Annotated[
    float | None,
    typer.Option(
        help="In ADC counts; that of the run's data.",
        rich_help_panel=ADC,
        callback=options.within(-1e9, 1e9),
    ),
]
Length = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=options.MAX_SAMPLES,
        help="Samples of a trace; those of a window.",
        rich_help_panel=ADC,
    ),
]
NPre = Annotated[
    int | None,
    typer.Option(
        min=0,
        max=options.MAX_SAMPLES,
        help="Samples before 99.9 % of the maximum; those of a window.",
        rich_help_panel=ADC,
    ),
]


@dataclass(frozen=True)
class AdcOptions:
    """Traces in ADC counts."""

    output: Annotated[Output, typer.Option(help="Form of the output.")] = Output.NORMALISED
    adc_per_kev: AdcPerKev = None
    baseline: Baseline = None
    length: Length = None
    n_pre: NPre = None

    def adc(self) -> Adc | None:
        """What is asked for, if traces are."""
        from cpunet.jobs.translation.translate_options import Adc

        adc = Adc(self.adc_per_kev, self.baseline, self.length, self.n_pre)
        if self.output == Output.ADC:
            return adc
        if adc != Adc():
            raise CpunetError(
                "--adc-per-kev, --baseline, --length and --n-pre belong to traces in ADC "
                "counts; add --output adc"
            )
        return None


@options.grouped
def translate(
    *,
    run: options.Run,
    sources: Sources,
    out_name: Out,
    inverse: options.Inverse = False,
    noise: Noise = True,
    remains: Remains = "none",
    pile_up_khz: PileUpKhz = 0.0,
    seed: options.Seed = 0,
    realisations: Realisations = None,
    table: Table = None,
    out_table: OutTable = None,
    energy: options.Energy = None,
    kev_per_adc: options.KevPerAdc = None,
    dt: options.Dt = None,
    insist: options.Insist = False,
    adc_options: AdcOptions,
    jobs: Jobs = 1,
    resume: Resume = False,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Translate files of pulses with a trained run, keeping their rows and columns.

    Example: cpunet translate run sim.lh5 --out translated.lh5

    Example: cpunet translate run sim_*.lh5 --out translated/ --jobs 4 --resume

    Example: cpunet translate runs sim.lh5 --table all --out translated/
    """
    from cpunet.jobs.translation.translate import translate_file
    from cpunet.jobs.translation.translate_channels import translate_channels
    from cpunet.jobs.translation.translate_files import expanded, translate_files
    from cpunet.jobs.translation.translate_options import TranslateOptions
    from cpunet.pulses.channels import ALL
    from cpunet.pulses.reading.files import PulseFile

    adc = adc_options.adc()
    files = [PulseFile(f, table, energy, kev_per_adc, dt, insist) for f in expanded(sources)]
    place = Path(out_name)
    form = TranslateOptions(
        inverse, noise, seed, out_table, realisations, adc, remains, pile_up_khz
    )
    how: dict[str, Any] = {"device": device, "resume": resume, "force": force}
    if table == ALL:
        if len(files) > 1:
            raise CpunetError(f"--table {ALL} belongs to one file, not to {len(files)}")
        outcome = translate_channels(run, files[0], place, form, **how)
        tell_channels(outcome, place, lambda told: _in_words(told, adc))
        return
    if len(files) > 1 or out_name.endswith("/") or place.is_dir():
        told = translate_files(run, files, place, form, jobs=jobs, **how)
    else:
        told = translate_file(run, files[0], place, form, **how)
    tell(f"{place}: {_in_words(told, adc)}")


def _in_words(told: dict[str, Any], adc: Adc | None) -> str:
    text = f"{told['translated']} of {told['read']} pulses translated"
    if "files" in told:
        text = f"{told['files']} files, {text}"
    if told.get("skipped"):
        which = f"{told['skipped']} files were" if "files" in told else "it was"
        text += f" ({which} there already)"
    rejected = ", ".join(f"{n} {reason}" for reason, n in told["rejections"].items())
    if rejected:
        text += f"; rows of {'NaN' if adc is None else '0'} for {rejected}"
    if told.get("saturated"):
        text += f"; {told['saturated']} saturated"
    return text
