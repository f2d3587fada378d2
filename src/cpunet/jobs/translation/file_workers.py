"""Tasks shared out among processes, with their progress and their errors."""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import Any, TypeVar

from cpunet.errors import CpunetError
from cpunet.jobs.common.monitor import Advance, Monitor

Task = TypeVar("Task")
Result = TypeVar("Result")
Work = Callable[[Task, Monitor], Result]

GRACE_S = 20.0  # to clean up, for a process that is told to stop


def in_processes(
    make: Callable[[], Work[Task, Result]],
    tasks: Sequence[Task],
    processes: int,
    advance: Advance,
    note: Callable[[str], None],
) -> Iterator[tuple[int, Result | CpunetError]]:
    """Do tasks in several processes; give results, or errors, as they come.

    Parameters
    ----------
    make
        Called once in each process for what does the tasks; can be pickled.
    tasks
        Can be pickled.
    processes
        At most so many.
    advance, note
        Told of the progress of all.

    Yields
    ------
    tuple
        Number of the task, and its result or the `CpunetError` that it ended with.  A process
        that is killed, as for want of memory, costs the task that it was at.
    """
    waiting = deque(enumerate(tasks))
    crew: dict[Connection, tuple[BaseProcess, int]] = {}
    try:
        while waiting or crew:
            while waiting and len(crew) < processes:
                connection, process = _start(make)
                crew[connection] = (process, _hand(connection, waiting.popleft()))
            ready = wait(list(crew))
            for connection in [one for one in crew if one in ready]:
                process, number = crew[connection]
                try:
                    kind, content = connection.recv()
                except (EOFError, ConnectionError):
                    del crew[connection]
                    yield number, _died(process)
                    continue
                if kind == "advance":
                    advance(content)
                elif kind == "note":
                    note(content)
                else:
                    if waiting:
                        crew[connection] = (process, _hand(connection, waiting.popleft()))
                    else:
                        del crew[connection]
                        connection.send(None)
                        process.join(GRACE_S)
                    yield number, CpunetError(content) if kind == "failed" else content
    finally:
        _stop([process for process, _ in crew.values()])


def _start(make: Callable[[], Any]) -> tuple[Connection, BaseProcess]:
    # not forked: threads of torch and of the HDF5 library do not survive that
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_work, args=(make, there), daemon=True)
    process.start()
    there.close()  # so that the end of the process is the end of the pipe
    return here, process


def _hand(connection: Connection, task: tuple[int, Any]) -> int:
    with suppress(ConnectionError):  # if it died, reading from it will tell
        connection.send(task[1])
    return task[0]


def _died(process: BaseProcess) -> CpunetError:
    process.join(GRACE_S)
    return CpunetError(
        f"its process ended with status {process.exitcode}; if the memory does not suffice, "
        "give fewer --jobs"
    )


def _stop(processes: list[BaseProcess]) -> None:
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(GRACE_S)
        if process.is_alive():
            process.kill()


class Relay(Monitor):
    """Passes on the steps of a stage, whose title and total are known, and lines.

    Parameters
    ----------
    advance, note
        Told of them.
    """

    def __init__(self, advance: Advance, note: Callable[[str], None]) -> None:
        self._advance, self._note = advance, note

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Pass on the steps of a stage."""
        del title, total
        yield self._advance

    def note(self, message: str) -> None:
        """Pass on a line."""
        self._note(message)


def _work(make: Callable[[], Work[Any, Any]], connection: Connection) -> None:
    """Do tasks until there are no more, in a process of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who started this one will tell it
    signal.signal(signal.SIGTERM, _leave)
    telling = Relay(
        lambda steps: connection.send(("advance", steps)),
        lambda message: connection.send(("note", message)),
    )
    work: Work[Any, Any] | None = None
    try:
        while (task := connection.recv()) is not None:
            try:
                work = make() if work is None else work
                connection.send(("done", work(task, telling)))
            except CpunetError as error:
                connection.send(("failed", str(error)))
    except (EOFError, ConnectionError):
        pass  # who started this one is gone


def _leave(number: int, _frame: FrameType | None) -> None:
    """Leave as on an error, so that nothing half-written stays."""
    sys.exit(128 + number)
