"""``cpunet summary``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell

Reports = Annotated[
    list[Path],
    typer.Argument(
        metavar="REPORT…", help="Folders of cpunet validate, as DETECTOR/PERIOD/report."
    ),
]
Out = Annotated[Path, typer.Option("--out", help="Page to write, such as index.html.")]
MissingOk = Annotated[
    bool, typer.Option("--missing-ok", help="List reports that are not there; no error.")
]


def summary(
    reports: Reports,
    out_file: Out,
    missing_ok: MissingOk = False,
    force: options.Force = False,
) -> None:
    """Put the scores of many detectors and periods on one page, with links to the reports.

    Example: cpunet summary results/*/*/report --out results/index.html
    """
    from cpunet.jobs.validation.summary_page import summarise_reports

    entries = summarise_reports(reports, out_file, missing_ok=missing_ok, force=force)
    missing = [entry.name for entry in entries if entry.metrics is None]
    for name in missing:
        tell(f"no report: {name}")
    tell(f"{out_file}: {len(entries) - len(missing)} of {len(entries)} reports")
