"""Validate a run: scores per peak, figures and a report."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from cpunet.errors import CpunetError
from cpunet.outputs import folder_written_aside
from cpunet.pulses.channels import Outcome, Pair, each_channel, own_folder, paired
from cpunet.pulses.reading.files import ALL, ReadOptions, Source
from cpunet.settings import require_seed
from cpunet.training.run import INFO, Run, RunLike, used_run
from cpunet.validation.compare import compared
from cpunet.validation.report import REPORT, Report

log = logging.getLogger(__name__)

INDEX = "index.html"


def validate(
    run: RunLike,
    sim: Source,
    data: Source,
    out: str | Path | None = None,
    *,
    truth: str | Path | None = None,
    baselines: bool = True,
    peak: str = "",
    max_pulses: int = 50_000,
    seed: int = 0,
    read: ReadOptions = ReadOptions(),
    force: bool = False,
) -> Report | Outcome[Report]:
    """Score a run per peak and write a report: figures, metrics.json, report.html.

    Every peak of the recipe is scored, and the energies of the training if they are not a
    peak.  SEP and DEP take no part in a training on the FEP: they are the test.

    Parameters
    ----------
    run
        Folder of a training run, or of runs by channel.
    sim
        Simulated pulses.
    data
        Measured pulses.
    out
        Report folder to make; without one, nothing is written.
    truth
        Noise-free responses of the simulated pulses (.npz), if given.
    baselines
        Fit the baseline methods too, which takes most of the time.
    peak
        Further energies to score in keV, as ``200-400`` or ``200-400,400-1000``.
    max_pulses
        Pulses of a side that are compared: of more, a random sample. Some 30 kB each.
    seed
        Seed of noise and bootstraps.
    read
        How the files are read.
    force
        Replace existing output.

    Returns
    -------
    Report or Outcome
        Scores, values, histograms and figures; with ``data_table="all"`` those of each
        channel, whose reports are folders in `out`, with a page of all.

    Raises
    ------
    CpunetError
        If an argument cannot be used, or no peak can be scored.

    Examples
    --------
    cpunet validate run --sim sim.lh5 --data raw.lh5 --out report

    cpunet validate runs --sim sim.lh5 --data raw.lh5 --data-table all --out reports
    """
    if max_pulses < 100:
        raise CpunetError(f"`max_pulses`: {max_pulses} are too few to compare", "give 100")
    sim, data = read.files(sim, data)
    folder = None if out is None else Path(out)
    score = partial(
        _validated,
        truth=None if truth is None else Path(truth),
        baselines=baselines,
        further=peak,
        max_pulses=max_pulses,
        seed=require_seed(seed),
        force=force,
    )
    if data.table != ALL:
        return score(used_run(run), (sim, data), folder)
    if folder is None:
        raise CpunetError(f"`data_table` {ALL}: give `out`, the folder of the reports")
    channels = paired(sim, data)
    outcome = each_channel(channels, folder, partial(_of_channel, run, score))
    if outcome.done:
        folders = [folder / name for name in channels]
        # without force, a channel with a report fails and keeps it
        failed = [folder / name for name in outcome.failed if force]
        compared(folders, failed=failed).save(folder / INDEX, force=True)
        log.info(f"all channels: {folder / INDEX}")
    return Outcome({n: Report.load(place) for n, place in outcome.done.items()}, outcome.failed)


def _validated(
    run: Run, pair: Pair, out: Path | None, *, truth: Path | None, force: bool, **how: Any
) -> Report:
    """Scores, and functions that draw; translated pulses are forgotten."""
    pair = run.sim.reading(pair[0]), run.data.reading(pair[1])
    read = (run.folder, *pair[0].files, *pair[1].files, truth)
    written = folder_written_aside(out, REPORT, *read, force=force) if out else nullcontext()
    with written as aside:
        # imported late: not needed for the help of the command
        from cpunet.validation.evaluation import evaluate

        evaluation = evaluate(run, *pair, truth=truth, **how)
        # nor is matplotlib while the pulses take most memory
        from cpunet.validation.figures import drawings

        notes = _notes(run, truth)
        drawn = drawings(evaluation)
        values = {peak.name: peak.values for peak in evaluation.sets if peak.values}
        report = Report(evaluation.metrics, values, out, drawn, notes)
        del evaluation  # all pulses
        if aside is not None:
            report.write(aside)
    return report


def _of_channel(
    runs: RunLike, score: Callable[..., Report], name: str, pair: Pair, folder: Path
) -> Path:
    """The folder of the report of a channel, made in a process of its own."""
    run = runs if isinstance(runs, Run) else own_folder(Path(runs), name, INFO)
    score(used_run(run), pair, folder)
    return folder


def _notes(run: Run, truth: Path | None) -> list[str]:
    notes = [
        f"Peaks other than {run.peak} took no part in the training.",
        "IoU is the overlap of two distributions in percent. Two samples of the same "
        "distribution do not reach 100 at finite size: data vs data is what two samples of the "
        "measured distribution have at these sizes.",
    ]
    tails = None if run.fit is None else run.fit.tails
    if tails is not None and tails.rate_khz:
        shares = ", ".join(
            f"{share['measured']:.1f} ({share['law']:.1f}) above {size.partition('_')[0]} keV"
            for size, share in tails.percent_above.items()
        )
        notes.append(
            f"Traces of the training lie on pile-up tails, {tails.rate_khz:.2f} ± "
            f"{tails.rate_error_khz:.2f} kHz decaying with {tails.decay_us:.1f} µs: "
            f"percent of the traces, measured (by the law), {shares}. All translations and the "
            "truth have tails drawn by this law, as likely as they pass the quality cuts."
        )
    if truth is None:
        notes.append("No truth was given, so single pulses are not scored.")
    return notes
