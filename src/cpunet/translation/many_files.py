"""Translate many files into a folder, in several processes; resumable."""

from __future__ import annotations

import glob
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from types import FrameType
from typing import Any

import torch

from cpunet.errors import CpunetError
from cpunet.kernels import use_threads
from cpunet.outputs import refuse_existing, refuse_inputs
from cpunet.progress import stage
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import Run
from cpunet.translation.file_translation import FileTranslation
from cpunet.translation.options import TranslateOptions

log = logging.getLogger(__name__)

OF_HDF5 = (".lh5", ".h5", ".hdf5", ".hdf")

Told = dict[str, Any]
_Outcomes = Generator[tuple["_Task", Told | str]]


@dataclass(frozen=True)
class _Task:
    source: PulseFile
    out: Path


def translate_files(
    run: Run,
    sources: Sequence[PulseFile],
    out: Path,
    options: TranslateOptions,
    *,
    jobs: int,
    device: str,
    resume: bool,
    force: bool,
) -> Told:
    """Translate files into files of the same names in a folder.

    The output depends on the seed and the name of a file, not on the number of processes or on
    the other files.  A file that cannot be translated does not stop the others.

    For the parameters see `cpunet.translate`.

    Returns
    -------
    dict
        ``files`` and ``skipped`` (numbers of files), and the counts of all their rows.

    Raises
    ------
    CpunetError
        Before the translation, if the run cannot be used, or outputs exist (without `resume`
        or `force`) or would have the same names; at the end, if files failed.
    """
    tasks = [_Task(source, out / _name(source.path)) for source in sources]
    if out.exists() and not out.is_dir():
        raise CpunetError(f"{out}: is a file, but several outputs need a folder")
    _refuse_inputs(tasks, run.folder)
    _require_apart(tasks, resume=resume, force=force)
    make = _Maker(run, options, device, resume, force)
    for doubt in FileTranslation(run, options, device).doubts:
        log.warning(doubt)
    told: list[Told] = []
    failed: list[str] = []
    with (
        stage("Translating", len(tasks)) as bar,
        closing(_outcomes(make, tasks, jobs)) as outcomes,
    ):
        for task, outcome in outcomes:
            bar.update()
            if isinstance(outcome, str):
                failed.append(_naming(task, outcome))
                log.error(failed[-1])
            else:
                told.append(outcome)
    if failed:
        done = f"; {len(told)} are in {out}" if told else ""
        raise CpunetError(
            f"{len(failed)} of {len(tasks)} files failed, the first: {failed[0]}{done}; "
            "continue with `resume`"
        )
    return _summed(told)


def expanded(name: Path) -> list[Path]:
    """The file of a name, or those that match a pattern (``*``, ``?``, ``[``).

    Raises
    ------
    CpunetError
        If no file matches a pattern.
    """
    if name.exists() or not glob.has_magic(str(name)):
        return [name]
    fitting = sorted(glob.glob(str(name), recursive=True))  # noqa: PTH207 (absolute ones too)
    if not fitting:
        raise CpunetError(f"{name}: no such files; check the name")
    return [*map(Path, fitting)]


@dataclass(frozen=True)
class _Maker:
    """The work of each process: one file after the other."""

    run: Run
    options: TranslateOptions
    device: str
    resume: bool
    force: bool

    def work(self) -> Callable[[_Task], Told]:
        """Return a function that translates a file."""
        # the last bits of a network depend on the number of threads, and processes share cores
        torch.set_num_threads(1)
        translation = FileTranslation(self.run, self.options, self.device)

        def work(task: _Task) -> Told:
            return translation(
                task.source,
                task.out,
                noise_key=task.out.name,
                resume=self.resume,
                force=self.force,
            )

        return work


def _outcomes(make: _Maker, tasks: Sequence[_Task], jobs: int) -> _Outcomes:
    """Yield the result of each task, or the reason why it failed."""
    if (jobs := min(jobs, len(tasks))) > 1:
        yield from _in_processes(make, tasks, jobs)
        return
    with _threads_kept():
        work = make.work()
        for task in tasks:
            yield task, _outcome(partial(work, task))


def _outcome(result: Callable[[], Told]) -> Told | str:
    try:
        return result()
    except (CpunetError, OSError) as error:
        return str(error)


def _in_processes(make: _Maker, tasks: Sequence[_Task], jobs: int) -> _Outcomes:
    """Yield outcomes as they arrive; the processes end when the iterator is closed."""
    context = multiprocessing.get_context("spawn")  # torch does not survive a fork
    others = {*multiprocessing.active_children()}
    noted: set[str] = set()
    left: dict[Future[tuple[Told | str, list[logging.LogRecord]]], _Task] = {}
    with ProcessPoolExecutor(jobs, context, _begin, (make,)) as pool:
        try:
            left |= {pool.submit(_work, task): task for task in tasks}
            while left:
                for future in wait(left, return_when=FIRST_COMPLETED).done:
                    outcome, records = future.result()
                    for record in records:
                        logger = logging.getLogger(record.name)
                        if record.msg not in noted and logger.isEnabledFor(record.levelno):
                            logger.handle(record)
                        noted.add(record.msg)
                    yield left.pop(future), outcome
        except BrokenProcessPool as error:
            raise CpunetError(
                "a process was ended, perhaps for lack of memory; try fewer `jobs`, and "
                "continue with `resume`"
            ) from error
        finally:
            if left:
                for process in {*multiprocessing.active_children()} - others:
                    process.terminate()
                pool.shutdown(cancel_futures=True)


# in a process of the pool: its work, and what it has to say
_translate: Callable[[_Task], Told]
_said: SimpleQueue[logging.LogRecord] = SimpleQueue()


def _begin(make: _Maker) -> None:
    """Begin the work of a process; its parent alone handles Ctrl-C, and may not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    use_threads(1)
    global _translate
    _translate = make.work()
    logger = logging.getLogger("cpunet")
    logger.addHandler(QueueHandler(_said))
    logger.setLevel(logging.INFO)
    logging.getLogger("cpunet.progress").setLevel(logging.ERROR)  # the parent counts files


def _leave(number: int, _frame: FrameType | None) -> None:
    """End in a way that removes the file being written."""
    signal.signal(number, signal.SIG_IGN)  # the pool repeats it
    sys.exit(128 + number)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(task: _Task) -> tuple[Told | str, list[logging.LogRecord]]:
    try:
        outcome = _outcome(partial(_translate, task))
    except SystemExit:  # which the pool would take for an outcome
        os._exit(1)
    return outcome, [_said.get() for _ in range(_said.qsize())]


@contextmanager
def _threads_kept() -> Iterator[None]:
    before = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _name(path: Path) -> str:
    return path.name if path.suffix.lower() in OF_HDF5 else f"{path.stem}.lh5"


def _refuse_inputs(tasks: Sequence[_Task], run: Path | None) -> None:
    """Raise a `CpunetError` if an output is an input of any task, or lies in the run.

    Thousands of files are compared by their identity, and not each with each other.
    """
    inputs = {_identity(task.source.path) for task in tasks} - {None}
    for task in tasks:
        refuse_inputs(task.out, run, *task.source.files)
        if _identity(task.out) in inputs:
            raise CpunetError(f"{task.out}: is the input; choose another `out`")


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and number of a file, the same under all its names; None if there is none."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_dev, stat.st_ino


def _require_apart(tasks: Sequence[_Task], *, resume: bool, force: bool) -> None:
    several = [name for name, n in Counter(task.out.name for task in tasks).items() if n > 1]
    if several:
        raise CpunetError(
            f"{len(several)} names occur twice among the files, as {several[0]}; "
            "translate these into folders of their own"
        )
    shared = next((t.source.energy for t in tasks if ":" in (t.source.energy or "")), None)
    if shared is not None and len(tasks) > 1:
        raise CpunetError(
            f"`energy` {shared} belongs to one file of pulses, not to {len(tasks)}; "
            "translate them one by one"
        )
    for task in tasks:
        if not resume:
            refuse_existing(task.out, force=force)


def _naming(task: _Task, text: str) -> str:
    """The error message, with the name of the file."""
    named = str(task.source.path) in text or str(task.out) in text
    return text if named else f"{task.source.path}: {text}"


def _summed(told: Sequence[Told]) -> Told:
    rejections: Counter[str] = Counter()
    for one in told:
        rejections.update(one.get("rejections", {}))
    names = ("read", "translated", "saturated")
    sums = {n: sum(one[n] for one in told) for n in names if all(n in one for one in told)}
    skipped = sum(bool(one.get("skipped")) for one in told)
    return {"files": len(told), "skipped": skipped, **sums, "rejections": dict(rejections)}
