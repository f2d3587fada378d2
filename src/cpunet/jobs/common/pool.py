"""A pool of processes that work through a list and end when it is finished or abandoned.

Processes are spawned, not forked: torch and CUDA do not survive a fork.  SIGTERM asks a worker
to stop, between two steps if its work supports that, otherwise at once.  A worker whose parent
has ended stops by itself.
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

PATIENCE_S = 60.0  # time to store a checkpoint before a worker is killed
LOST_AFTER_S = 10.0  # time after which a process that should end at once is killed
TELL_EVERY_S = 0.5  # interval of progress messages
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Outcome:
    """Outcome of an item: a result, or the reason why there is none."""

    item: Any
    result: Any = None
    failure: str | None = None


class Link:
    """Connection of a worker to its parent."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._asked = self._wanted = False
        self._steps, self._told = 0, 0.0

    def advance(self, steps: int) -> None:
        """Report completed steps, at most every `TELL_EVERY_S` seconds."""
        self._steps += steps
        if time.monotonic() - self._told >= TELL_EVERY_S:
            self.flush()

    def flush(self) -> None:
        """Report completed steps now."""
        if self._steps:
            self._send("steps", self._steps)
        self._steps, self._told = 0, time.monotonic()

    def note(self, message: str) -> None:
        """Send a note to the user."""
        self._send("note", message)

    def _send(self, kind: str, content: Any) -> None:
        with suppress(OSError):  # a worker whose parent has ended is stopped elsewhere
            self._pipe.send((kind, content))

    @contextmanager
    def stoppable(self) -> Iterator[Callable[[], bool]]:
        """Yield a function that returns whether to stop.

        Once it has been called, a first SIGTERM does not end the process at once: the function
        returns true, and the process ends after the ``with`` block.
        """

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
        """Record a request to stop, or stop at once if the work does not check for it."""
        if not self._asked or self._wanted:
            # an exit raised within an import or a callback can be lost
            _later(LOST_AFTER_S, lambda: os._exit(128 + number))
            sys.exit(128 + number)
        self._wanted = True


Work = Callable[[Any], Any]
Begin = Callable[[Link], Work]


def shared_cores(
    jobs: int | None, threads: int | None, items: int, device: str
) -> tuple[int, int]:
    """Numbers of processes for some items, and of CPU threads of each.

    By default there is one process per core, or one on a GPU, and they share the cores.
    """
    jobs = jobs or (1 if device.startswith("cuda") else cores())
    jobs = max(1, min(jobs, items))
    return jobs, threads or max(1, cores() // jobs)


def cores() -> int:
    """Number of CPU cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def work_off(
    begin: Begin, items: Iterable[Any], *, jobs: int, threads: int, monitor: Monitor
) -> Generator[Outcome | int, None, None]:
    """Process all items in parallel; yield outcomes as they arrive, and steps in between.

    Close the iterator to end the processes (`contextlib.closing`).

    Parameters
    ----------
    begin
        Function called once in each process with its `Link`; returns the function that is
        called with each item.  It, items and results must be picklable.
    items
        Items to process, in this order.
    jobs
        Number of parallel processes.
    threads
        CPU threads per process.
    monitor
        Receiver of notes, each only once.

    Yields
    ------
    Outcome or int
        Outcome of an item, or a number of steps (`Link.advance`).  An item fails if its work
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
    """The processes and their current items."""

    def __init__(self, begin: Begin, threads: int) -> None:
        self.busy: dict[Connection, Any] = {}
        self._begin, self._threads = begin, threads
        self._processes: dict[Connection, BaseProcess] = {}

    def give(self, item: Any) -> None:
        """Assign an item to an idle process or to a new one."""
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
        """Receive a message: its kind and content."""
        try:
            kind, content = pipe.recv()
        except (EOFError, OSError):
            return "failure", _ending(self._forget(pipe))
        return str(kind), content

    def end(self) -> None:
        """End all processes; those with a state store it first."""
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
    """Start a process with its share of threads; the parent alone handles Ctrl-C."""
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
    """Work until the parent has no more items or has ended."""
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
        link.flush()
        try:
            pipe.send(message)
        except OSError:
            return


def _later(seconds: float, act: Callable[[], None]) -> None:
    timer = threading.Timer(seconds, act)
    timer.daemon = True
    timer.start()


def _tell_unraisable(unraisable: Any) -> None:
    """Like Python's hook, but silent about a lost exit."""
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
