"""Validate the run of each channel of a data file, with a page of all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cpunet.jobs.validation.compare import compare_reports
from cpunet.jobs.validation.evaluation import ValidateOptions
from cpunet.jobs.validation.validate import validate_run
from cpunet.pulses.channels import Outcome, Pair, one_by_one, own_folder, paired
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import INFO

AS_USUAL = ValidateOptions()
INDEX = "index.html"


def validate_channels(
    runs: Path,
    sim: PulseFile,
    data: PulseFile,
    out: Path,
    how: ValidateOptions = AS_USUAL,
    *,
    force: bool = False,
) -> Outcome[dict[str, Any]]:
    """Validate ``RUNS/CHANNEL`` for each channel of the data, in the folder ``OUT/CHANNEL``.

    ``OUT/index.html`` shows all channels and links to their reports.

    Parameters
    ----------
    runs
        Folder of runs by channel, or one run for all channels.
    sim, data
        Input files; the table of the data is ``"all"``, that of the simulation can be.
    out
        Folder of the report folders.

    Returns
    -------
    Outcome
        Content of each ``metrics.json``, and the reasons why channels have none.

    Raises
    ------
    CpunetError
        If the files cannot be read, or `out` is a report itself.
    """

    def validate(name: str, pair: Pair, folder: Path) -> dict[str, Any]:
        run = own_folder(runs, name, INFO)
        return validate_run(run, *pair, folder, how, force=force)

    channels = paired(sim, data)
    outcome = one_by_one(channels, out, validate)
    if outcome.done:
        folders = [out / name for name in channels]
        # without force, a channel with a report fails and keeps it
        failed = [out / name for name in outcome.failed if force]
        compare_reports(folders, out=out / INDEX, failed=failed, missing_ok=True, force=True)
    return outcome
