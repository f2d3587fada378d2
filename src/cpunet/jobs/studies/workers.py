"""Several processes that work off a list, and are gone when it is done or given up.

Processes are spawned, not forked: torch and CUDA do not survive a fork.  SIGTERM asks a worker
to stop; one whose work can be stopped between two steps does so there, any other at once.  A
worker whose parent is gone stops by itself.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import Any

import torch

from cpunet.errors import CpunetError
from cpunet.jobs.common.monitor import Monitor
from cpunet.training.loop import StoppedError

PATIENCE_S = 60.0  # for a checkpoint to be stored, before a worker is ended the hard way
LOST_AFTER_S = 10.0  # from when on a process that is to end at once does so the hard way
TELL_EVERY_S = 0.5  # between two messages of progress
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Outcome:
    """What became of an item: a result, or the reason why there is none."""

    item: Any
    result: Any = None
    failure: str | None = None


class Link:
    """A worker's line to its parent."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._asked = self._wanted = False
        self._steps, self._told = 0, 0.0

    def advance(self, steps: int) -> None:
        """Tell of steps done."""
        self._steps += steps
        if time.monotonic() - self._told >= TELL_EVERY_S:
            self._send("steps", self._steps)
            self._steps, self._told = 0, time.monotonic()

    def note(self, message: str) -> None:
        """Tell the user something."""
        self._send("note", message)

    def _send(self, kind: str, content: Any) -> None:
        with suppress(OSError):  # a parent that is gone ends us in its own way
            self._pipe.send((kind, content))

    @contextmanager
    def stoppable(self) -> Iterator[Callable[[], bool]]:
        """Give what says whether to stop; from when it is first asked, nothing else stops."""

        def stop() -> bool:
            self._asked = True
            return self._wanted

        try:
            yield stop
        finally:
            self._asked = False
        if self._wanted:
            sys.exit(128 + signal.SIGTERM)

    def take_signal(self, number: int, _frame: FrameType | None) -> None:
        """Remember a wish to stop, or stop at once if nobody asks for it."""
        if not self._asked or self._wanted:
            # an exit that is raised within an import or a callback may be lost
            _later(LOST_AFTER_S, lambda: os._exit(128 + number))
            sys.exit(128 + number)
        self._wanted = True


Work = Callable[[Any], Any]
Begin = Callable[[Link], Work]


def default_jobs(device: str) -> int:
    """Processes if the user names no number: one per core, or one on a GPU."""
    return 1 if device.startswith("cuda") else cores()


def cores() -> int:
    """CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def work_off(
    begin: Begin, items: Iterable[Any], *, jobs: int, threads: int, monitor: Monitor
) -> Generator[Outcome | int, None, None]:
    """Do all items in some processes; give each outcome as it comes, and steps done between.

    Close the iterator to end the processes (`contextlib.closing`).

    Parameters
    ----------
    begin
        Called once in each process with its `Link`; gives what is called with each item.
        It, items and results must be picklable.
    items
        What to do, in this order.
    jobs
        Processes at a time.
    threads
        CPU threads of each.
    monitor
        Told of notes, each once.

    Yields
    ------
    Outcome or int
        An item's outcome, or a number of steps (`Link.advance`).  An item fails if its work
        raises a `CpunetError` or an `OSError`, or its process ends.
    """
    waiting, workers = deque(items), _Workers(begin, threads)
    noted: set[str] = set()
    try:
        while waiting or workers.busy:
            while waiting and len(workers.busy) < jobs:
                workers.give(waiting.popleft())
            for pipe in wait(list(workers.busy)):
                assert isinstance(pipe, Connection)
                kind, content = workers.hear(pipe)
                if kind == "steps":
                    yield content
                elif kind == "note":
                    if content not in noted:
                        monitor.note(content)
                    noted.add(content)
                else:
                    yield Outcome(workers.busy.pop(pipe), **{kind: content})
    finally:
        workers.end()


class _Workers:
    """Processes, and what each is busy with."""

    def __init__(self, begin: Begin, threads: int) -> None:
        self.busy: dict[Connection, Any] = {}
        self._begin, self._threads = begin, threads
        self._processes: dict[Connection, BaseProcess] = {}

    def give(self, item: Any) -> None:
        """Give an item to an idle process, or to a new one."""
        idle = next((pipe for pipe in self._processes if pipe not in self.busy), None)
        pipe = self._start() if idle is None else idle
        try:
            pipe.send(item)
        except OSError:  # it ended while idle
            self._forget(pipe)
            pipe = self._start()
            pipe.send(item)
        self.busy[pipe] = item

    def hear(self, pipe: Connection) -> tuple[str, Any]:
        """A message: its kind and content."""
        try:
            kind, content = pipe.recv()
        except (EOFError, OSError):
            return "failure", _ending(self._forget(pipe))
        return str(kind), content

    def end(self) -> None:
        """End all processes, those that keep a state with it stored."""
        for process in self._processes.values():
            process.terminate()
        until = time.monotonic() + PATIENCE_S
        for process in self._processes.values():
            process.join(max(0.0, until - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
        for pipe in self._processes:
            pipe.close()
        self._processes.clear()

    def _start(self) -> Connection:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(
            target=_serve, args=(theirs, self._begin, self._threads), daemon=True
        )
        with _inherited(self._threads):
            process.start()
        theirs.close()
        self._processes[ours] = process
        return ours

    def _forget(self, pipe: Connection) -> int | None:
        process = self._processes.pop(pipe)
        process.join()
        pipe.close()
        return process.exitcode


def _ending(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        hint = "; perhaps for lack of memory, try fewer --jobs" if name == "SIGKILL" else ""
        return f"its process was ended by {name}{hint}"
    return f"its process ended with status {code}"


@contextmanager
def _inherited(threads: int) -> Iterator[None]:
    """Have a process start with its share of threads, and deaf to Ctrl-C: we hear it."""
    before = {name: os.environ.get(name) for name in _THREADS}
    main = threading.current_thread() is threading.main_thread()
    heard = signal.signal(signal.SIGINT, signal.SIG_IGN) if main else None
    os.environ.update({name: str(threads) for name in _THREADS})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if main:
            signal.signal(signal.SIGINT, heard)


def _serve(pipe: Connection, begin: Begin, threads: int) -> None:
    """Work until the parent has nothing more, or is gone."""
    link = Link(pipe)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, link.take_signal)
    sys.unraisablehook = _tell_unraisable
    threading.Thread(target=_stop_after_parent, daemon=True).start()
    torch.set_num_threads(threads)
    work: Work | None = None
    while True:
        try:
            item = pipe.recv()
        except EOFError:
            return
        try:
            work = begin(link) if work is None else work
            message = ("result", work(item))
        except StoppedError:
            return
        except (CpunetError, OSError) as error:
            message = ("failure", str(error))
        try:
            pipe.send(message)
        except OSError:
            return


def _later(seconds: float, act: Callable[[], None]) -> None:
    timer = threading.Timer(seconds, act)
    timer.daemon = True
    timer.start()


def _tell_unraisable(unraisable: Any) -> None:
    """As Python does it, but say nothing of an exit that was lost."""
    if not isinstance(unraisable.exc_value, SystemExit):
        sys.__unraisablehook__(unraisable)


def _stop_after_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(PATIENCE_S)
    os._exit(1)
