"""Independent work in several processes, one thread each; one failure does not stop the others.

What is made does not depend on the number of processes: with one, the work is done here, with
one thread as well, since the last bits of a network depend on the number of threads.

OpenBLAS threads wait for each other in busy loops.  The matrices here are small: a second
thread brings no gain on idle cores.  On busy cores the other threads wait for one that has no
core; this made scores take twelve times as long.  Both thresholds of the C library's memory are
set each time, so that no choice of an earlier job remains.
"""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from types import FrameType
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from cpunet.errors import CpunetError

# Signals by which terminals and batch systems end a job, as far as the system has them
_NAMES = ("INT", "TERM", "HUP", "QUIT", "USR1", "USR2", "XCPU")
STOPPING = [getattr(signal, f"SIG{n}") for n in _NAMES if hasattr(signal, f"SIG{n}")]

T = TypeVar("T")
R = TypeVar("R")


def usable_cores() -> int:
    """Cores that this process may use; no more than ``OMP_NUM_THREADS``, if that is set."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux only
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, int(asked)) if asked.isdecimal() and int(asked) else cores


def outcomes(
    make: Callable[[], Callable[[T], R]], tasks: Sequence[T], jobs: int, *, once: bool = False
) -> Generator[tuple[T, R | CpunetError]]:
    """Yield each task with its result, or the error it failed with, as they arrive.

    Parameters
    ----------
    make
        Called once in each process; returns the function that does a task.  It, the tasks and
        the results are pickled.
    tasks
        What to do.
    jobs
        Processes, at most; they end when the generator is closed.
    once
        Log a message once, however many tasks have it.

    Raises
    ------
    CpunetError
        If a process is ended from outside.
    """
    alone = multiprocessing.current_process().daemon  # which may have no children
    if (jobs := min(jobs, len(tasks))) > 1 and not alone:
        yield from _in_processes(make, tasks, jobs, once)
        return
    torch = sys.modules.get("torch")
    before = 0 if torch is None else torch.get_num_threads()
    try:
        if torch is not None:
            torch.set_num_threads(1)
        work = make()
        for task in tasks:
            yield task, _outcome(work, task)
    finally:
        if torch is not None:
            torch.set_num_threads(before)


def _in_processes(
    make: Callable[[], Callable[[T], R]], tasks: Sequence[T], jobs: int, once: bool
) -> Generator[tuple[T, R | CpunetError]]:
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise CpunetError(f"a process runs the script that began it; {_GUARD}")
    context = multiprocessing.get_context("spawn")  # threads do not survive a fork
    others, noted = {*multiprocessing.active_children()}, set[str]()
    left: dict[Future[tuple[Any, list[logging.LogRecord]]], T] = {}
    with ProcessPoolExecutor(jobs, context, _begin, (make,)) as pool:
        try:
            left |= {pool.submit(_work, task): task for task in tasks}
            for future in as_completed([*left]):
                outcome, records = future.result()
                for record in records:
                    logger = logging.getLogger(record.name)
                    again = once and record.msg in noted
                    if not again and logger.isEnabledFor(record.levelno):
                        logger.handle(record)
                    noted.add(record.msg)
                yield left.pop(future), outcome
        except BrokenProcessPool as error:
            # each process runs the main script again, which may have no guard
            script = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
            if script.is_file() and b"__main__" not in script.read_bytes():
                raise CpunetError(
                    f"{script}: processes run this script again; {_GUARD}"
                ) from error
            raise CpunetError(
                "a process was ended, perhaps for lack of memory; use fewer processes "
                "(OMP_NUM_THREADS, or `jobs`), and continue with `resume`"
            ) from error
        finally:
            if left:
                for process in {*multiprocessing.active_children()} - others:
                    process.terminate()
                pool.shutdown(cancel_futures=True)


_GUARD = 'put its calls under if __name__ == "__main__":'


def _outcome(work: Callable[[T], R], task: T) -> R | CpunetError:
    try:
        return work(task)
    except (CpunetError, OSError) as error:
        return CpunetError(str(error))


# in a process of the pool: its work, and the messages that it has for its parent
_do: Callable[[Any], Any]
_messages: SimpleQueue[logging.LogRecord] = SimpleQueue()


def _begin(make: Callable[[], Callable[[Any], Any]]) -> None:
    """Begin the work of a process; its parent alone handles Ctrl-C, and may not outlive it."""

    def leave(number: int, _frame: FrameType | None) -> None:
        """End in a way that removes what is being written."""
        signal.signal(number, signal.SIG_IGN)  # the pool repeats it
        sys.exit(128 + number)

    def end_with_parent() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    for number in STOPPING:
        if number == signal.SIGINT:
            signal.signal(number, signal.SIG_IGN)
        elif signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, leave)
    threading.Thread(target=end_with_parent, daemon=True).start()
    from cpunet.kernels import use_threads  # imported late: numba takes a second

    use_threads(1)
    global _do
    _do = make()
    logger = logging.getLogger("cpunet")
    logger.addHandler(QueueHandler(_messages))
    logger.setLevel(logging.INFO)
    logging.getLogger("cpunet.progress").setLevel(logging.ERROR)  # the parent counts tasks


def _work(task: Any) -> tuple[Any, list[logging.LogRecord]]:
    try:
        outcome = _outcome(_do, task)
    except SystemExit:  # which the pool would take for an outcome
        os._exit(1)
    return outcome, [_messages.get() for _ in range(_messages.qsize())]


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # constants of glibc's malloc.h


def _set_thresholds(mmap_bytes: int, trim_bytes: int) -> None:
    """Set from which size on the C library gives freed memory back to the system."""
    with suppress(OSError, AttributeError, TypeError):  # another C library
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, mmap_bytes)
        library.mallopt(_TRIM_THRESHOLD, trim_bytes)


# For jobs that process files block by block: arrays of a megabyte or more go back to the
# system.  By default the C library eventually keeps such arrays on its heap, which becomes
# fragmented and grows.
give_back_large_arrays = partial(_set_thresholds, 1 << 20, 1 << 17)
# For trainings: all freed memory stays.  Every step of a network allocates and frees the same
# hundreds of megabytes; to get them from the system again takes a tenth of the step and more.
keep_freed_memory = partial(_set_thresholds, 2**31 - 1, 2**31 - 1)


@contextmanager
def one_thread_for_matrices() -> Iterator[None]:
    """Let matrix products and decompositions use one thread; also a decorator of jobs."""
    import scipy.linalg  # noqa: F401 - loads its own OpenBLAS, to be limited as well

    # OpenBLAS only: torch can have its own library, and the matrices of networks are large
    with ThreadpoolController().select(internal_api="openblas").limit(limits=1):
        yield
