"""Call a command in a process of its own, and measure the resources it uses."""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from cpunet.cli.main import main as cpunet_main

MAX_S = 30
_LONGEST_S = 900  # wall-clock time, whatever the load of the machine
_MAX_ADDRESSES = 12 << 30
_WITH_WORKERS = ("ensemble", "tune")  # commands whose workers import the main module again
_SOURCE = "import sys; sys.argv[0] = 'cpunet'; from cpunet.cli.main import main; main()"


@dataclass
class Case:
    """One call: its words, what was changed, and whether it must fail or succeed."""

    words: list[str]
    told: str
    must_fail: bool = False
    must_succeed: bool = False
    environment: dict[str, str] = field(default_factory=dict)
    closed: str = ""  # standard output: "closed" or "full"; or "errors closed", "errors full"
    fresh: bool = False  # in an interpreter of its own, instead of a fork


@dataclass(frozen=True)
class Outcome:
    """How a case ended.

    Attributes
    ----------
    cpu_s
        Processor time of the process and of its children.
    own_s
        Time until its end without the time spent waiting for a core, so that other load on the
        machine does not count.
    """

    status: int
    out: str
    err: str
    cpu_s: float
    own_s: float
    wall_s: float
    kb: int
    late: bool


def call(words: list[str], folder: Path) -> None:
    """Call a command that must succeed."""
    outcome = run(Case(words, ""), folder, folder)
    if outcome.status != 0:
        raise SystemExit(f"{' '.join(words)}: {outcome.err}")


def run(case: Case, folder: Path, logs: Path) -> Outcome:
    """Run a case: in a fork, or in an interpreter of its own."""
    out, err = logs / ".stdout", logs / ".stderr"
    begun = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _become(case, folder, out, err)
    late, own_s, ticks, waited = False, 0.0, 0, dict[int, float]()
    while True:
        done, code, usage = os.wait4(pid, os.WNOHANG)
        if done:
            break
        wall = time.monotonic() - begun
        ticks += 1
        if ticks % 20 == 0:  # ten times a second
            for each in _family(pid):
                waited[each] = _waited_for_a_core(each)
            own_s = wall - sum(waited.values())
            if own_s > MAX_S or wall > _LONGEST_S:
                late = True
                os.killpg(pid, signal.SIGKILL)
                _, code, usage = os.wait4(pid, 0)
                break
        time.sleep(0.005)
    with suppress(ProcessLookupError):  # processes that it has left behind
        os.killpg(pid, signal.SIGKILL)
    cpu_s = usage.ru_utime + usage.ru_stime
    return Outcome(
        status=os.waitstatus_to_exitcode(code),
        out=out.read_text("utf-8", "replace") if out.exists() else "",
        err=err.read_text("utf-8", "replace") if err.exists() else "",
        cpu_s=cpu_s,
        own_s=max(own_s, cpu_s),
        wall_s=time.monotonic() - begun,
        kb=usage.ru_maxrss,
        late=late or cpu_s > MAX_S,
    )


def _family(pid: int) -> list[int]:
    """A process and all its descendants."""
    found = [pid]
    for each in found:
        with suppress(OSError):
            text = Path(f"/proc/{each}/task/{each}/children").read_text()
            found += map(int, text.split())
    return found


def _waited_for_a_core(pid: int) -> float:
    """Seconds that a process was ready to run but had no core; the longest of its threads."""
    with suppress(OSError, IndexError, ValueError):
        texts = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/schedstat")]
        return max(int(text.split()[1]) for text in texts) / 1e9
    return 0.0


def _become(case: Case, folder: Path, out: Path, err: Path) -> None:
    """In the child: set up streams and environment, run the case and exit."""
    status = 99
    try:
        os.setsid()
        os.chdir(folder)
        os.environ.update(case.environment)
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        os.dup2(os.open("/dev/full" if case.closed == "full" else out, flags), 1)
        os.dup2(os.open("/dev/full" if case.closed == "errors full" else err, flags), 2)
        if case.closed == "closed":
            os.close(1)
        if case.closed == "errors closed":
            os.close(2)
        resource.setrlimit(resource.RLIMIT_AS, (_MAX_ADDRESSES, _MAX_ADDRESSES))
        if case.fresh or case.words[0] in _WITH_WORKERS:
            words = [os.fsencode(word) for word in [sys.executable, "-c", _SOURCE, *case.words]]
            os.execv(sys.executable, words)
        sys.stdout = sys.stderr = None  # as Python sets them if they are closed
        if case.closed != "closed":
            sys.stdout = os.fdopen(1, "w", encoding="utf-8")
        if case.closed != "errors closed":
            sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace")
        sys.argv = ["cpunet", *case.words]
        cpunet_main()
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else 98
    except BaseException:
        traceback.print_exc()
        status = 97
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, AttributeError, ValueError):
                stream.flush()
        os._exit(status)
