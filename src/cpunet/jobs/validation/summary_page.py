"""Reports of many detectors and periods on one page."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from cpunet.analysis.report import METRICS
from cpunet.analysis.summary_page import Entry, summary_page
from cpunet.errors import CpunetError
from cpunet.files import written_aside
from cpunet.jobs.validation.compare import read_metrics
from cpunet.outputs import refuse_existing

REPORT = "report"  # folder name that does not identify its content
PAGE = "report.html"


def summarise_reports(
    reports: Sequence[Path], out: Path, *, missing_ok: bool = False, force: bool = False
) -> list[Entry]:
    """Write a summary page of the reports of many detectors and periods.

    Parameters
    ----------
    reports
        Folders of `cpunet validate`, as ``DETECTOR/PERIOD/report`` or
        ``DETECTOR/PERIOD``; the folder names identify detector and period.
    out
        Page to write, with links to the reports.
    missing_ok
        Whether to list missing or unfinished reports instead of raising.
    force
        Whether to replace an existing page.

    Returns
    -------
    list of Entry
        Entries of the reports, in their order.

    Raises
    ------
    CpunetError
        If a report is missing or cannot be read, two reports have the same detector and
        period, no report exists, or `out` exists or is not writable.
    """
    if out.is_dir():
        raise CpunetError(f"{out}: is a folder; give the name of a page, as index.html")
    refuse_existing(out, *reports, force=force)
    entries = []
    known: dict[tuple[str, str], Path] = {}
    for report in reports:
        whose = detector_and_period(report)
        if whose in known:
            raise CpunetError(
                f"{report}: of detector {whose[0]} and period {whose[1]}, as is "
                f"{known[whose]}; put reports at DETECTOR/PERIOD/report"
            )
        known[whose] = report
        entries.append(_entry(report, whose, out.parent, missing_ok=missing_ok))
    if all(entry.metrics is None for entry in entries):
        raise CpunetError(f"{out}: none of the {len(entries)} reports is there yet")
    page = summary_page(entries)
    with written_aside(out) as aside:
        aside.write_text(page, encoding="utf-8")
    return entries


def detector_and_period(report: Path) -> tuple[str, str]:
    """Names of detector and period from the folder of a report.

    Examples
    --------
    >>> detector_and_period(Path("results/V01/p03/report"))
    ('V01', 'p03')
    >>> detector_and_period(Path("results/V01/p03"))
    ('V01', 'p03')
    """
    # not resolved: the name of a link counts
    folders = Path(os.path.abspath(report)).parts  # noqa: PTH100 (takes out "..", too)
    if folders[-1] == REPORT:
        folders = folders[:-1]
    *_, detector, period = ("", "", *folders)
    return detector, period


def _entry(report: Path, whose: tuple[str, str], beside: Path, *, missing_ok: bool) -> Entry:
    file = report / METRICS
    if not file.is_file():
        if missing_ok:
            return Entry(*whose)
        raise CpunetError(
            f"{report}: no {METRICS} in it; give a folder of cpunet validate, or --missing-ok"
        )
    metrics = read_metrics(file)
    page = report / PAGE
    link = quote(os.path.relpath(page, beside)) if page.is_file() else None
    return Entry(*whose, metrics, link)
