"""The command ``cpunet``: its subcommands, and errors as one line."""

from __future__ import annotations

import logging
import signal
import sys
from typing import Annotated

import typer

import cpunet
from cpunet.cli.app import app as commands
from cpunet.cli.app import run, with_options
from cpunet.cli.boundary import ended_with, stop
from cpunet.cli.calibrate import calibrate
from cpunet.cli.demo import demo
from cpunet.cli.environment import share_the_machine
from cpunet.cli.messages import messages_to_stderr, out
from cpunet.cli.response import response
from cpunet.cli.stand import stand
from cpunet.cli.tune import tune
from cpunet.installation import other_package

log = logging.getLogger(__name__)

DEBUG = "--debug"


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
Debug = Annotated[
    bool, typer.Option(DEBUG, help="Show the whole traceback if a command fails.")
]
app = typer.Typer(
    help="Make simulated germanium-detector pulses look measured.",
    epilog=f"Further commands: {', '.join(name for name in commands if name[0] != '-')}",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)


@app.callback()
def _options(version: Version = False, debug: Debug = False) -> None:
    pass


for command in (
    demo,
    stand,
    calibrate,
    tune,
    response,
):
    app.command()(command)


def main() -> None:
    """Run the command line: it ends in one line on stderr, if anything goes wrong."""
    words = sys.argv[1:]
    end = words.index("--") if "--" in words else len(words)  # then names only
    debug = DEBUG in words[:end]  # known wherever it stands, also before anything is imported
    words = [word for word in words[:end] if word != DEBUG] + words[end:]
    with messages_to_stderr(with_options):
        try:
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, stop)
            share_the_machine()
            if clash := other_package():
                log.warning(clash)
            of_functions = (
                words[:1] and not words[0].startswith("-") and words[0] in [*commands]
            )
            status = run(words) if of_functions else app(words, standalone_mode=False)
        except BaseException as error:
            status = ended_with(error, words, debug=debug)
    sys.exit(status or 0)
