"""Translate many files into a folder, in several processes; resumable."""

from __future__ import annotations

import glob
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
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

Summary = dict[str, Any]  # counts of a file, or of all
Task = tuple[PulseFile, Path]  # a file and its output
Work = Callable[[Task], Summary]


def translate_files(
    run: Run,
    sources: Sequence[PulseFile],
    out: Path,
    options: TranslateOptions,
    *,
    jobs: int,
    device: str,
    **how: bool,
) -> Summary:
    """Translate files into files of the same names in a folder.

    The output depends on the seed and the name of a file, not on the number of processes or on
    the other files.  A file that cannot be translated does not stop the others.

    For the parameters see `cpunet.translate`; `how` are its ``resume`` and ``force``.

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
    tasks = [(source, out / _name(source.path)) for source in sources]
    if out.exists() and not out.is_dir():
        raise CpunetError(f"{out}: is a file, but several outputs need a folder")
    _check(tasks, run.folder, **how)
    make = partial(_work_of, run, options, device, how)
    FileTranslation(run, options, device).warn()  # what cannot be used is refused once
    done: list[Summary] = []
    failed: list[str] = []
    with (
        stage("Translating", len(tasks)) as bar,
        closing(outcomes(make, tasks, jobs, once=True)) as found,
    ):
        for (source, target), outcome in found:
            bar.update()
            if isinstance(outcome, CpunetError):
                text = str(outcome)
                named = str(source.path) in text or str(target) in text
                failed.append(text if named else f"{source.path}: {text}")
                log.error(failed[-1])
            else:
                done.append(outcome)
    if failed:
        others = f"; {len(done)} are in {out}" if done else ""
        raise CpunetError(
            f"{len(failed)} of {len(tasks)} files failed, the first: {failed[0]}{others}; "
            "continue with `resume`"
        )
    rejections = sum((Counter(one["rejections"]) for one in done), Counter[str]())
    sums = {
        name: sum(one[name] for one in done)
        for name in ("read", "translated", "saturated")
        if all(name in one for one in done)
    }
    skipped = sum("skipped" in one for one in done)
    return {"files": len(done), "skipped": skipped, **sums, "rejections": dict(rejections)}


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


def _work_of(run: Run, options: TranslateOptions, device: str, how: Mapping[str, bool]) -> Work:
    """Return a function that translates a file after the other."""
    translation = FileTranslation(run, options, device)
    return lambda task: translation(task[0], task[1], noise_key=task[1].name, **how)


def _name(path: Path) -> str:
    return path.name if path.suffix.lower() in OF_HDF5 else f"{path.stem}.lh5"


def _check(tasks: Sequence[Task], run: Path | None, *, resume: bool, force: bool) -> None:
    """Raise a `CpunetError` if an output is an input, exists, or has the name of another.

    Thousands of files are compared by their identity, and not each with each other.
    """
    several = [name for name, n in Counter(out.name for _, out in tasks).items() if n > 1]
    if several:
        raise CpunetError(
            f"{len(several)} names occur twice among the files, as {several[0]}; "
            "translate these into folders of their own"
        )
    shared = next((s.energy for s, _ in tasks if s.energy and ":" in s.energy), None)
    if shared is not None and len(tasks) > 1:
        raise CpunetError(
            f"`energy` {shared} belongs to one file of pulses, not to {len(tasks)}; "
            "translate them one by one"
        )
    inputs = {_identity(source.path) for source, _ in tasks} - {None}
    for source, out in tasks:
        refuse_inputs(out, run, *source.files)
        if _identity(out) in inputs:
            raise CpunetError(f"{out}: is the input; choose another `out`")
        if not resume:
            refuse_existing(out, force=force)


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and number of a file, the same under all its names; None if there is none."""
    if not path.exists():
        return None
    stat = path.stat()
    return stat.st_dev, stat.st_ino
