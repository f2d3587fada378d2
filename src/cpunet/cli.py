"""The command ``cpunet``: commands made of the public functions by their signatures.

Results go to stdout, messages and progress to stderr.  Whatever ends a command becomes one line
and an exit status: 2 for what the user can mend, 1 for a result that is not ``ok`` and for what
nobody thought of, 128 and more for a signal.
"""

from __future__ import annotations

import errno
import inspect
import io
import logging
import os
import re
import signal
import sys
import traceback
from collections.abc import Sequence
from functools import cache
from types import FrameType
from typing import Any

import cyclopts
from cyclopts import App, Parameter

import cpunet
from cpunet import DISTRIBUTION, other_package
from cpunet.errors import CpunetError
from cpunet.processes import STOPPING

log = logging.getLogger(__name__)

# What a command does. Its public function has the same name, or one of these.
COMMANDS = {
    "demo": "Simulate, digitise, train, translate and validate on a stand with a given answer.",
    "check": "Say whether simulated and measured pulses can be compared, or what to do.",
    "export legend": "Export a readout chain as parameters for LEGEND's simulation chain.",
    "export onnx": "Export the deterministic part of a run as ONNX.",
    "import": "Make a run of the weights that the authors published.",
    "info": "Say what is in a file, detector, run or report.",
    "response": "Say in terms of physics what readout was learned, with the truth if given.",
    "library make": "Simulate the charge pulse of every place in a detector.",
    "library translate": "Translate a library of charge pulses with a run, without noise.",
    "simulate": "Simulate pulses of a detector, from hits of a file or of Tl-208 gammas.",
    "stand": "Make a test stand: simulated pulses, raw traces of other events, and the truth.",
    "train": "Train REN and IREN on simulated and measured pulses, unpaired.",
    "translate": "Translate pulses with a trained run; rows and columns of files stay.",
    "calibrate": "Calibrate the detector and its electronics together.",
    "validate": "Score a run per peak and write a report.",
    "compare": "Compare the scores of several validations.",
}
FUNCTIONS = {
    "import": "import_weights",
    "library make": "make_library",
    "library translate": "translate_library",
    "stand": "make_stand",
}

GROUPS = {
    "export": App(name="export", help="Write a run for other software."),
    "library": App(name="library", help="Make and translate pulse-shape libraries."),
}
# Parameters whose options have other names.
SHORT = {"electronics": "preset", "settings": "set"}

DEBUG, USAGE, BUG = "--debug", 2, 1
HELP = {"--help", "-h"}
# Turns of the loop in which a thread of OpenMP waits before it sleeps: about 0.1 ms, longer
# than most gaps between two operations and far shorter than others hold a core.
SPIN_COUNT = "3000"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
NO_MEMORY = ("allocate memory", "out of memory", "unable to allocate")


def _option(name: str) -> str:
    return SHORT.get(name) or cyclopts.default_name_transform(name)


def with_options(text: str) -> str:
    """A text in which parameters in backticks are the options that they are."""
    return re.sub(r"`([a-z_]+)`", lambda name: f"--{_option(name[1])}", text)


app = App(
    name="cpunet",
    help="Make simulated germanium-detector pulses look measured.\n\n"
    f"{DEBUG} shows the whole traceback if a command fails.",
    version=f"cpunet {cpunet.__version__}",
    # of "a path or an object", the command line takes paths
    default_parameter=Parameter(
        accepts_keys=False, consume_multiple=False, name_transform=_option, negative_iterable=()
    ),
    result_action="return_value",
)
for _group in GROUPS.values():
    app.command(_group)
for _name, _help in COMMANDS.items():  # whose functions are loaded when they are called
    *_group_of, _word = _name.split()
    _function = FUNCTIONS.get(_name) or _name.replace(" ", "_")
    (GROUPS[_group_of[0]] if _group_of else app).command(
        f"{cpunet.HOMES[_function]}:{_function}", name=_word, help=_help
    )


@cache
def application() -> App:
    """The application, in which parameters of these classes are options of their own.

    Their modules load NumPy, which the list of all commands need not wait for.
    """
    from cpunet.pulses.reading.files import FileOptions, ReadOptions
    from cpunet.simulation.hits import HitOptions
    from cpunet.translation.options import Adc

    for options in (Adc, FileOptions, HitOptions, ReadOptions):
        Parameter(name="*", accepts_keys=True)(options)
    return app


def run(words: Sequence[str]) -> int:
    """Run the command of some words, print its result, and return the exit status.

    Raises
    ------
    CpunetError
        If the words are no command, or the command fails; parameters, which stand in
        backticks, are named as the options that they are.
    """
    called = app if not words or words[0].startswith("-") else application()
    try:
        result: Any = called(words, exit_on_error=False, print_error=False)
    except cyclopts.CycloptsError as error:
        command = " ".join(["cpunet", *(error.command_chain or ())])
        text = " ".join(str(error).split())
        # more words list the first of all commands
        if isinstance(error, cyclopts.UnknownCommandError):
            text = text.partition(" Available commands")[0]
        if isinstance(error, cyclopts.MissingArgumentError) and error.argument is not None:
            text = f"{error.argument.names[0]} is missing"
        raise CpunetError(text.rstrip("."), f"see {command} --help") from error
    except CpunetError as error:
        raise CpunetError(with_options(str(error))) from error
    if HELP.intersection(words):
        # examples of the command, from the docstring of its function; none of a group
        names = [word for word in words if word[0] != "-"]
        function = app.parse_commands(names)[1][-1].default_command
        _, _, after = (inspect.getdoc(function) or "").partition("Examples\n--------\n")
        lines = [
            f"  {line}\n" for line in (line.strip("` ") for line in after.splitlines()) if line
        ]
        sys.stdout.writelines(["Examples:\n", *lines] if after else [])
    if not words or (words[0] in GROUPS and len(words) == 1):
        return USAGE  # the help was shown
    if result is not None:
        print(with_options(str(result)))  # noqa: T201 - the only place that prints
    return 0 if getattr(result, "ok", True) else BUG


def main() -> None:
    """Run the command line: it ends in one line on stderr, if anything goes wrong."""
    debug = DEBUG in sys.argv  # wherever it stands
    words = [word for word in sys.argv[1:] if word != DEBUG]
    logger, handler = logging.getLogger("cpunet"), logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Lines())
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)

    def stop(number: int, _frame: FrameType | None) -> None:
        sys.exit(128 + number)  # which leaves nothing half-written, as an error does

    caught = [n for n in STOPPING if signal.getsignal(n) != signal.SIG_IGN]  # as by nohup
    handlers = {n: signal.signal(n, stop) for n in caught}
    try:
        # Pictures are written to files, whatever backend a notebook shows its own with; a
        # terminal that says it is no column wide shows text as any other.
        os.environ["MPLBACKEND"] = "agg"
        for name in ("COLUMNS", "LINES", "NUMBA_NUM_THREADS"):
            if not os.environ.get(name, "1").isdecimal() or os.environ.get(name) == "0":
                del os.environ[name]
        # OpenMP's threads wait for each other in busy loops: if other programs run as well, the
        # thread that the others wait for often has no core, because a waiting one occupies it.
        # Short loops bridge the gaps between two operations; a thread that waits longer sleeps.
        if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
            os.environ["GOMP_SPINCOUNT"] = SPIN_COUNT
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):  # of any encoding
                stream.reconfigure(errors="replace")
        if clash := other_package():
            log.warning(clash)
        status = run(words)
    except BaseException as error:
        status = _ended_with(error, words, debug=debug)
    finally:
        for number, earlier in handlers.items():
            signal.signal(number, earlier)
        logger.setLevel(level)
        logger.removeHandler(handler)
    sys.exit(status)


class _Lines(logging.Formatter):
    """One line for each record, which begins with its level if that is a warning or more."""

    def format(self, record: logging.LogRecord) -> str:
        line = with_options(" ".join(super().format(record).split()))
        if record.levelno < logging.WARNING:
            return line
        level = f"{record.levelname.lower()}:"
        return f"\033[1m{level}\033[0m {line}" if sys.stderr.isatty() else f"{level} {line}"


def _ended_with(error: BaseException, words: Sequence[str], *, debug: bool) -> int:
    """Say in one line what a command of these words ended with; return the exit status."""
    text, status = " ".join(str(error).split()), USAGE
    if isinstance(error, BrokenPipeError):  # nobody reads on, as in "cpunet … | head"
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BUG
    if isinstance(error, KeyboardInterrupt | SystemExit):
        code = error.code if isinstance(error, SystemExit) else 128 + signal.SIGINT
        status = code if isinstance(code, int) else BUG
        if status in (128 + number for number in STOPPING):
            log.error("interrupted; nothing half-written was left")
        return status
    if debug:
        traceback.print_exception(error)
    files = ", ".join(word for word in words if os.path.exists(word))  # noqa: PTH110
    about = f"{files}: " if files else ""
    if isinstance(error, CpunetError):
        pass
    elif isinstance(error, MemoryError) or any(part in text.lower() for part in NO_MEMORY):
        text = f"{about}out of memory ({text[:200]}); take fewer pulses, or smaller batches"
    elif isinstance(error, OSError) and error.errno:
        remedy = "make room" if error.errno in FULL else "check its name and permissions"
        about = f"{error.filename}: "[-200:] if error.filename else about
        text = f"{about}{os.strerror(error.errno)}; {remedy}, or choose another place"
    else:
        what, status = f"{about}unexpected {type(error).__name__} ({text[:200]})", BUG
        remedy = f"report it to the makers of {DISTRIBUTION}, with what {DEBUG} prints"
        text = f"{what}; please {remedy}"
    log.error(text)
    return status
