"""The command ``cpunet``: its subcommands, and errors as one line."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType
from typing import Annotated

import typer

import cpunet
from cpunet.cli.calibrate import calibrate
from cpunet.cli.check import check
from cpunet.cli.compare import compare
from cpunet.cli.demo import demo
from cpunet.cli.ensemble import ensemble
from cpunet.cli.explore import explore
from cpunet.cli.export import export
from cpunet.cli.fields import fields
from cpunet.cli.figure import figure
from cpunet.cli.import_weights import import_
from cpunet.cli.info import info
from cpunet.cli.library import library
from cpunet.cli.messages import fail, out, warn
from cpunet.cli.response import response
from cpunet.cli.simulate import simulate
from cpunet.cli.stand import stand
from cpunet.cli.summary import summary
from cpunet.cli.train import train
from cpunet.cli.translate import translate
from cpunet.cli.tune import tune
from cpunet.cli.validate import validate
from cpunet.errors import CpunetError
from cpunet.installation import other_package

# Turns of the loop in which a thread of OpenMP waits before it sleeps: about 0.1 ms, longer
# than most gaps between two operations and far shorter than others hold a core.
SPIN_COUNT = "3000"


def _tell_version(wanted: bool) -> None:
    if wanted:
        out.print(f"cpunet {cpunet.__version__}", highlight=False)
        raise typer.Exit


Version = Annotated[
    bool,
    typer.Option(
        "--version", callback=_tell_version, is_eager=True, help="Show the version and exit."
    ),
]
app = typer.Typer(
    help="Make simulated germanium-detector pulses look measured.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)


@app.callback()
def _options(version: Version = False) -> None:
    pass


for command in (
    demo,
    simulate,
    fields,
    stand,
    check,
    train,
    calibrate,
    ensemble,
    tune,
    translate,
    validate,
    compare,
    summary,
    response,
    figure,
    explore,
    export,
    info,
):
    app.command()(command)
app.add_typer(library, name="library")
app.add_typer(import_, name="import")


def main() -> None:
    """Run the command line; bad input ends in one line and status 2."""
    _share_the_machine()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    if clash := other_package():
        warn(clash)
    try:
        app()
    except CpunetError as error:
        fail(str(error))
        sys.exit(2)


def _stop(number: int, _frame: FrameType | None) -> None:
    """Leave as on an error, so that Ctrl-C and batch systems leave nothing half-written."""
    fail("interrupted; nothing half-written was left")
    sys.exit(128 + number)


def _share_the_machine() -> None:
    """Keep OpenMP's threads from spinning for long, before torch loads it.

    By default they wait for each other in busy loops. Where something else runs too, the
    thread that is waited for often has no core, and the loop takes the one it could have:
    trainings then take several times as much of the machine. Short loops bridge the gaps
    between two operations; whoever waits longer sleeps. Whoever sets OpenMP's own variables
    is obeyed.
    """
    if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
        os.environ["GOMP_SPINCOUNT"] = SPIN_COUNT
