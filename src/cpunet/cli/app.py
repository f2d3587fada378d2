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
from cpunet.simulation.hits import HitOptions
from cpunet.translation.options import Adc

# Each field of these is an option of its own.
for _options in (Adc, FileOptions, HitOptions, ReadOptions):
    Parameter(name="*", accepts_keys=True)(_options)

_SHORT = {"settings": "set", "settings_file": "settings"}


# Where the function of a command is, and what it does.
COMMANDS = {
    "check": (
        "cpunet.training.check:check",
        "Say whether simulated and measured pulses can be compared, and what to do if not.",
    ),
    "export legend": (
        "cpunet.legend.export:export_legend",
        "Export a readout chain as parameters for LEGEND's simulation chain.",
    ),
    "export onnx": (
        "cpunet.translation.export:export_onnx",
        "Export the deterministic part of a run as ONNX.",
    ),
    "import": (
        "cpunet.training.published:import_weights",
        "Make a run of the weights that the authors published.",
    ),
    "info": ("cpunet.inspection:info", "Say what is in a file, detector, run or report."),
    "library make": (
        "cpunet.legend.make_library:make_library",
        "Simulate the charge pulse of every place in a detector.",
    ),
    "library translate": (
        "cpunet.legend.translate_library:translate_library",
        "Translate a library of charge pulses with a trained run, without noise.",
    ),
    "simulate": (
        "cpunet.simulation.simulate:simulate",
        "Simulate pulses of a detector, from hits of a file or of Tl-208 gammas.",
    ),
    "train": (
        "cpunet.training.train:train",
        "Train REN and IREN on simulated and measured pulses, unpaired.",
    ),
    "translate": (
        "cpunet.translation.translate:translate",
        "Translate pulses with a trained run, keeping the rows and columns of their files.",
    ),
    "validate": (
        "cpunet.validation.validate:validate",
        "Score a run per peak and write a report.",
    ),
    "compare": (
        "cpunet.validation.compare:compare",
        "Put the scores of several validations beside each other.",
    ),
}


def _option(name: str) -> str:
    return _SHORT.get(name) or default_name_transform(name)


def with_options(text: str) -> str:
    """A text in which parameters in backticks are the options that they are."""
    return re.sub(r"`([a-z_]+)`", lambda name: f"--{_option(name[1])}", text)


app = App(
    name="cpunet",
    help="Make simulated germanium-detector pulses look measured.",
    version=cpunet.__version__,
    # of "a path or an object", the command line takes paths
    default_parameter=Parameter(
        accepts_keys=False,
        consume_multiple=False,
        name_transform=_option,
        negative_iterable=(),
    ),
    result_action="return_value",
)
GROUPS = {
    "export": App(name="export", help="Write a run for other software."),
    "library": App(name="library", help="Make and translate pulse-shape libraries."),
}
for _group in GROUPS.values():
    app.command(_group)
for _name, (_function, _help) in COMMANDS.items():
    *_group_of, _word = _name.split()
    (GROUPS[_group_of[0]] if _group_of else app).command(_function, name=_word, help=_help)


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
        raise CpunetError(with_options(str(error))) from error
    if result is not None:
        tell(with_options(str(result)))
    return 0 if getattr(result, "ok", True) else 1
