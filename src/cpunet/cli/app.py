"""Commands made of the public functions by their signatures and docstrings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from cyclopts import App, CycloptsError, Parameter, default_name_transform

import cpunet
from cpunet.cli.messages import tell
from cpunet.errors import CpunetError
from cpunet.pulses.reading.files import FileOptions, ReadOptions

# Each field of these is an option of its own.
for _options in (FileOptions, ReadOptions):
    Parameter(name="*", accepts_keys=True)(_options)

_SHORT = {"settings": "set", "settings_file": "settings"}


def _option(name: str) -> str:
    return _SHORT.get(name) or default_name_transform(name)


app = App(
    name="cpunet",
    help="Make simulated germanium-detector pulses look measured.",
    version=cpunet.__version__,
    # of "a path or an object", the command line takes paths
    default_parameter=Parameter(
        accepts_keys=False, consume_multiple=False, name_transform=_option
    ),
    result_action="return_value",
)
app.command(
    "cpunet.training.published:import_weights",
    name="import",
    help="Make a run of the weights that the authors published.",
)


def run(words: Sequence[str]) -> int:
    """Run the command of some words, print its result, and return the exit status.

    Raises
    ------
    CpunetError
        If the words are no command, or the command fails; parameters, which stand in
        backticks, are named as the options that they are.
    """
    try:
        result: Any = app(words, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        told = " ".join(str(error).split()).rstrip(".")
        command = " ".join(["cpunet", *(error.command_chain or ())])
        raise CpunetError(told, f"see {command} --help") from error
    except CpunetError as error:
        text = re.sub(r"`([a-z_]+)`", lambda name: f"--{_option(name[1])}", str(error))
        raise CpunetError(text) from error
    if result is not None:
        tell(str(result))
    return 0 if getattr(result, "ok", True) else 1
