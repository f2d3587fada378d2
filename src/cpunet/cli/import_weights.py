"""``cpunet import``: what the authors of CPU-Net published, in this package's formats."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell

log = logging.getLogger(__name__)

import_ = typer.Typer(
    help="Published weights become a run, pickled pulses an LH5 file; nothing is executed.",
    no_args_is_help=True,
)

Ren = Annotated[Path | None, typer.Option("--ren", help="Simulation → data: fep_REN.pt.")]
Iren = Annotated[Path | None, typer.Option("--iren", help="Data → simulation: fep_IREN.pt.")]
DataSide = Annotated[
    Path | None, typer.Option("--discriminator-data", help="fep_netD_A.pth, for the record.")
]
SimSide = Annotated[
    Path | None, typer.Option("--discriminator-sim", help="fep_netD_B.pth, for the record.")
]
OutRun = Annotated[Path, typer.Option("--out", help="Run folder to make.")]
Out = Annotated[Path, typer.Option("--out", help="LH5 file to write.")]
Source = Annotated[Path, typer.Argument(help="File of pickled pulses.", metavar="FILE")]
Dt = Annotated[float, typer.Option("--dt-ns", "--dt", help="Sampling period in ns.")]
Peak = Annotated[str, typer.Option(help="What the weights were trained on.")]
Table = Annotated[str, typer.Option(help="Table to write.")]
Units = Annotated[str, typer.Option(help="Units of the samples.")]


@import_.command()
def weights(
    out_folder: OutRun,
    ren: Ren = None,
    iren: Iren = None,
    discriminator_data: DataSide = None,
    discriminator_sim: SimSide = None,
    dt: Dt = 16.0,
    peak: Peak = "FEP",
    force: options.Force = False,
) -> None:
    """Make a run folder of the published state dicts.

    Example: cpunet import weights --ren fep_REN.pt --iren fep_IREN.pt --out run
    """
    from cpunet.jobs.training.import_published import import_weights

    run = import_weights(
        out_folder,
        ren=ren,
        iren=iren,
        discriminator_data=discriminator_data,
        discriminator_sim=discriminator_sim,
        dt_ns=dt,
        peak=peak,
        force=force,
    )
    tell(f"{out_folder}: a run of {', '.join(run.imported)}")


@import_.command()
def pulses(
    source: Source,
    out_file: Out,
    dt: Dt = 16.0,
    table: Table = "geds/raw",
    units: Units = "ADC",
    force: options.Force = False,
) -> None:
    """Convert a pickled list of pulses to LH5.

    Example: cpunet import pulses fep_data.pickle --out pulses.lh5
    """
    from cpunet.jobs.training.import_published import import_pulses

    told = import_pulses(source, out_file, dt_ns=dt, table=table, units=units, force=force)
    rejected = "".join(f", {n} {reason}" for reason, n in told["rejections"].items())
    tell(f"{out_file}: {told['written']} of {told['read']} pulses{rejected}")
    if told["truncated"]:
        log.info(
            f"{source}: ends within a pulse or is damaged there; what was before it is written"
        )
