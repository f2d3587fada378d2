"""Translate many files into a folder, in several processes; resumable."""

from __future__ import annotations

import glob
import logging
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_existing, refuse_inputs
from cpunet.processes import outcomes
from cpunet.progress import stage
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import Run
from cpunet.translation.file_translation import FileTranslation
from cpunet.translation.options import TranslateOptions

log = logging.getLogger(__name__)

OF_HDF5 = (".lh5", ".h5", ".hdf5", ".hdf")

Told = dict[str, Any]


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
        closing(outcomes(make.work, tasks, jobs, once=True)) as found,
    ):
        for task, outcome in found:
            bar.update()
            if isinstance(outcome, CpunetError):
                failed.append(_naming(task, str(outcome)))
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
