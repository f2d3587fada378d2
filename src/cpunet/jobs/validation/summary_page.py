"""Reports of many detectors and periods on one page."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from cpunet.analysis.report_folder import METRICS
from cpunet.analysis.summary_page import Entry, summary_page
from cpunet.analysis.verdicts import part
from cpunet.errors import CpunetError
from cpunet.files import written_aside
from cpunet.jobs.validation.compare import read_metrics
from cpunet.outputs import refuse_existing

REPORT = "report"  # folder name that does not identify its content
PAGE = "report.html"


def summarise_reports(
    reports: Sequence[Path],
    out: Path,
    *,
    names: Sequence[tuple[str, str]] | None = None,
    failed: Collection[Path] = (),
    missing_ok: bool = False,
    force: bool = False,
) -> list[Entry]:
    """Write a summary page of the reports of many detectors and periods.

    Parameters
    ----------
    reports
        Folders of `cpunet validate`, as ``DETECTOR/PERIOD/report`` or ``DETECTOR/PERIOD``.
        If some do not record detector (or channel) and period, or two record the same, the
        folder names are used instead.
    out
        Page to write, with links to the reports.
    names
        Detector and period of each report, if known otherwise.
    failed
        Reports to list as missing: what is in their folders is of an earlier validation.
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
    found = [
        None if report in failed else _metrics(report, missing_ok=missing_ok)
        for report in reports
    ]
    whose = names or _recorded(found) or [detector_and_period(report) for report in reports]
    known: dict[tuple[str, str], Path] = {}
    entries = []
    for report, one, metrics in zip(reports, whose, found, strict=True):
        if one in known:
            raise CpunetError(
                f"{report}: of detector {one[0]} and period {one[1]}, as is "
                f"{known[one]}; put reports at DETECTOR/PERIOD/report"
            )
        known[one] = report
        target = report / PAGE
        linked = report not in failed and target.is_file()
        link = quote(os.path.relpath(target, out.parent)) if linked else None
        entries.append(Entry(*one, metrics, link))
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
    # not resolved, since the name of a link counts
    folders = Path(os.path.abspath(report)).parts  # noqa: PTH100 (takes out "..", too)
    if folders[-1] == REPORT:
        folders = folders[:-1]
    *_, detector, period = ("", "", *folders)
    return detector, period


def _recorded(found: Sequence[Mapping[str, Any] | None]) -> list[tuple[str, str]] | None:
    """Detectors and periods as recorded; None if one is not, or if two are the same."""
    names = []
    for metrics in found:
        told = part(metrics or {}, "compared")
        names.append((told.get("channel") or told.get("detector"), told.get("period")))
    known = [(str(detector), str(period)) for detector, period in names if detector and period]
    return known if len(set(known)) == len(names) else None


def _metrics(report: Path, *, missing_ok: bool) -> dict[str, Any] | None:
    """Content of ``metrics.json``; None if it may be missing and is."""
    file = report / METRICS
    if file.is_file():
        return read_metrics(file)
    if missing_ok:
        return None
    raise CpunetError(
        f"{report}: no {METRICS} in it; give a folder of cpunet validate, or --missing-ok"
    )
