"""`cpunet.translate`: make simulated pulses look measured, or the other way round."""

from __future__ import annotations

import glob
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_existing
from cpunet.processes import outcomes
from cpunet.progress import stage
from cpunet.pulses.channels import Outcome, Pair, channels_of, each_channel, own_folder
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.files import ALL, FileOptions, PulseFile, Source, pulse_file
from cpunet.training.run import INFO, Run, RunLike, as_run, used_run
from cpunet.translation.file_translation import FileTranslation, Task
from cpunet.translation.options import NONE, Adc, TranslateOptions
from cpunet.translation.translation import Counts, Translation

log = logging.getLogger(__name__)

OF_HDF5 = (".lh5", ".h5", ".hdf5", ".hdf")

Make = Callable[[RunLike], FileTranslation]


def translate(
    run: RunLike,
    pulses: Sequence[Source] | Source | npt.ArrayLike,
    out: str | Path | None = None,
    *,
    inverse: bool = False,
    noise: bool = True,
    tails: str | float = NONE,
    pile_up_khz: float = 0.0,
    adc: bool = False,
    scale: Adc = Adc(),
    out_table: str | None = None,
    seed: int = 0,
    jobs: int = 1,
    resume: bool = False,
    read: FileOptions = FileOptions(),
    insist: bool = False,
    force: bool = False,
) -> Translation | Outcome[Translation]:
    """Translate pulses with a trained run, keeping the rows and columns of their files.

    Parameters
    ----------
    run
        A trained run or its folder; for all tables of a file, a folder of runs by table.
    pulses
        A file of pulses, several, or patterns as ``sim_*.lh5``; or pulses in memory, or an
        array of shape (n, samples) with the sampling of the run.
    out
        LH5 file to write; for several files, or with a slash at its end, a folder.  Without
        it, pulses stay in memory.
    inverse
        Translate measured pulses to simulation-like ones.
    noise
        Add noise as the data have it.  It is the same in memory and in a file.
    tails
        Pile-up tails: ``learned``, ``none``, or a rate in kHz.
    pile_up_khz
        Rate in kHz of piled-up pulses within a trace.
    adc
        Make raw traces in ADC counts, as a digitiser's, instead of normalised windows.
    scale
        Settings of these traces.
    out_table
        Table to write; ``geds/ren`` or ``geds/iren`` by default.
    seed
        Seed of the noise.
    jobs
        Processes, each of which translates a file at a time.
    resume
        Leave files that exist already, if made from the same input in the same way.
    read
        How files are read, if they do not tell themselves.  With ``all`` for the table, each
        table is translated to a file in `out`.
    insist
        Skip the check whether pulses are simulated or measured.
    force
        Replace existing files.

    Returns
    -------
    Translation
        The translated pulses; those of each table if all are translated.

    Raises
    ------
    CpunetError
        If an argument cannot be used, no pulse can be translated, or files failed.

    Examples
    --------
    cpunet translate run sim.lh5 --out translated.lh5
    cpunet translate run sim_*.lh5 --out translated/ --jobs 4 --resume
    cpunet translate runs sim.lh5 --table all --out translated/
    """
    if scale != Adc() and not adc:
        raise CpunetError(
            "`adc_per_kev`, `baseline`, `length`, `n_pre` and `bits` belong to traces in ADC "
            "counts; add `adc`"
        )
    if jobs < 1:
        raise CpunetError(f"`jobs` is {jobs}; expected 1 or more")
    digits = scale if adc else None
    options = TranslateOptions(inverse, noise, seed, out_table, digits, tails, pile_up_khz)
    files = [pulse_file(source, read, insist) for source in _sources(pulses, run)]
    several = len(files) > 1 or str(out).endswith("/") or (out and Path(out).is_dir())
    channels = any(file.table == ALL for file in files)
    if out is None and (several or channels):
        raise CpunetError("several files or tables do not stay in memory; give `out`")
    make = partial(FileTranslation, options=options, resume=resume, force=force)
    if out is None:
        return make(used_run(run)).in_memory(files[0])
    if channels:
        if len(files) > 1:
            raise CpunetError(f"`table` {ALL} belongs to one file, not to {len(files)}")
        return _channels(make, run, files[0], Path(out))
    if several:
        return _several(make, used_run(run), files, Path(out), jobs)
    return make(used_run(run))((files[0], Path(out), None))


def _sources(
    given: Sequence[Source] | Source | npt.ArrayLike, run: RunLike
) -> Iterator[Source]:
    """Names of files and pulses from all that a user may give."""
    sources: list[Any] = [given] if isinstance(given, Source) else list(given)  # type: ignore[arg-type]
    if not sources:
        raise CpunetError("there are no pulses to translate; give some")
    if not all(isinstance(source, Source) for source in sources):
        waveforms = np.atleast_2d(np.asarray(given, np.float32))
        sources = [Pulses.of(waveforms, dt_ns=as_run(run).dt_ns)]
    for source in sources:
        names = [source]
        # a name with such a character may be that of a file
        if isinstance(source, str | Path) and not Path(source).exists():
            pattern = str(source)
            if glob.has_magic(pattern):
                names = sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207 absolute, too
            if not names:
                raise CpunetError(f"{pattern}: no such files; check the name")
        yield from names


def _channels(make: Make, runs: RunLike, source: PulseFile, out: Path) -> Outcome[Translation]:
    """Translate each table of a file with ``RUNS/CHANNEL`` into ``OUT/CHANNEL.lh5``.

    A single table, such as a simulation that serves all channels, is translated with each
    run.  The noise depends on the seed and the name of the channel, so that of channels
    differs.
    """
    channels: dict[str, Pair] = {n: (file, file) for n, file in channels_of(source).items()}
    if len(channels) == 1 and not isinstance(runs, Run):
        (name, single), *_ = channels.items()
        if not own_folder(Path(runs), name, INFO).is_dir():
            trained = sorted(info.parent.name for info in Path(runs).glob(f"*/{INFO}"))
            channels = dict.fromkeys(trained, single) or channels
    return each_channel(channels, out, partial(_channel, make, runs))


def _channel(make: Make, runs: RunLike, name: str, pair: Pair, place: Path) -> Translation:
    run = used_run(runs if isinstance(runs, Run) else own_folder(Path(runs), name, INFO))
    return make(run)((pair[0], place.with_name(f"{name}.lh5"), name))


def _several(
    make: Make, run: Run, sources: Sequence[PulseFile], out: Path, jobs: int
) -> Translation:
    """Translate files into files of the same names in a folder.

    The output depends on the seed and the name of a file, not on the number of processes
    or on the other files.  A file that cannot be translated does not stop the others.

    Raises
    ------
    CpunetError
        Before the translation, if the run cannot be used, or outputs exist (without
        `resume` or `force`) or would have the same names; at the end, if files failed.
    """
    if out.exists() and not out.is_dir():
        raise CpunetError(f"{out}: is a file, but several outputs need a folder")
    job, tasks = make(run), dict[Path, Task]()
    # thousands of files are compared by their identity, and not each with each other; a file
    # that a link among the inputs points to is one of them
    stats = [source.path.stat() for source in sources if source.path.exists()]
    inputs = {(stat.st_dev, stat.st_ino) for stat in stats}
    for source in sources:
        to = out / source.path.name
        to = to if to.suffix.lower() in OF_HDF5 else to.with_suffix(".lh5")
        if to in tasks:
            raise CpunetError(
                f"names occur twice among the files, as {to.name}; translate these into "
                "folders of their own"
            )
        if len(sources) > 1 and ":" in (source.energy or ""):
            raise CpunetError(
                f"`energy` {source.energy} belongs to one file of pulses, not to "
                f"{len(sources)}; translate them one by one"
            )
        refuse_existing(to, run.folder, *source.files, force=job.force or job.resume)
        if to.exists() and (to.stat().st_dev, to.stat().st_ino) in inputs:
            raise CpunetError(f"{to}: is the input; choose another `out`")
        tasks[to] = source, to, to.name
    counts, failed = Counts(), list[str]()
    # what the job says is said once: others make theirs in processes of their own
    begin = partial(make, run) if jobs > 1 else lambda: job
    with (
        stage("Translating", len(tasks)) as bar,
        closing(outcomes(begin, [*tasks.values()], jobs, once=True)) as results,
    ):
        for (source, to, _), outcome in results:
            bar.update()
            if isinstance(outcome, CpunetError):
                text = str(outcome)
                named = str(source.path) in text or str(to) in text
                failed.append(text if named else f"{source.path}: {text}")
                log.error(failed[-1])
            else:
                counts += outcome.counts
    if failed:
        done = len(tasks) - len(failed)
        others = f"; {done} are in {out}" if done else ""
        raise CpunetError(
            f"{len(failed)} of {len(tasks)} files failed, the first: {failed[0]}{others}; "
            "continue with `resume`"
        )
    return job.result(replace(counts, files=len(tasks)), path=out)
