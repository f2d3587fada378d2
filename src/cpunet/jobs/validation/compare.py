"""Read the reports of several validations and compare them."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_existing, written_aside
from cpunet.settings import read_json
from cpunet.validation.report_folder import METRICS
from cpunet.validation.side_by_side import SideBySide, side_by_side
from cpunet.validation.side_by_side_page import side_by_side_page

REPORT = "report"  # folder of a demonstration that contains the metrics
PAGE = "report.html"


class Compared(NamedTuple):
    """Scores of several runs, and the names of the reports that are missing."""

    table: SideBySide
    missing: tuple[str, ...]


def compare_reports(
    reports: Sequence[Path],
    *,
    method: str = "ren",
    out: Path | None = None,
    failed: Collection[Path] = (),
    missing_ok: bool = False,
    force: bool = False,
) -> Compared:
    """Compare the scores of several validations, of one detector or of many.

    Parameters
    ----------
    reports
        Folders of `cpunet validate` or `cpunet demo`, or their ``metrics.json``.
    method
        Method that is scored.
    out
        HTML page to write, with links to the reports; None for none.
    failed
        Reports to list as missing: what is in their folders is of an earlier validation.
    missing_ok
        Whether to list missing or unfinished reports instead of raising.
    force
        Whether to replace an existing page.

    Returns
    -------
    Compared
        Scores of the runs, which have the names of their folders, made unique, such as
        ``DETECTOR/PERIOD``.

    Raises
    ------
    CpunetError
        If a report is missing or cannot be read, none has a score of `method`, or `out`
        exists or is not writable.
    """
    if out is not None:
        if out.is_dir():
            raise CpunetError(f"{out}: is a folder; give the name of a page, as compare.html")
        refuse_existing(out, *reports, force=force)
    found = [
        None if report in failed else _metrics_file(report, missing_ok=missing_ok)
        for report in reports
    ]
    names = _names(reports)
    files = {n: file for n, file in zip(names, found, strict=True) if file is not None}
    if not files:
        raise CpunetError(f"none of the {len(reports)} reports is there yet")
    missing = tuple(name for name in names if name not in files)
    runs = {name: read_metrics(file) for name, file in files.items()}
    table = side_by_side(runs, method)
    if out is not None:
        pages = {name: file.parent / PAGE for name, file in files.items()}
        links = {
            name: quote(os.path.relpath(page, out.parent))
            for name, page in pages.items()
            if page.is_file()
        }
        with written_aside(out) as aside:
            page = side_by_side_page(table, runs, links, missing)
            aside.write_text(page, encoding="utf-8")
    return Compared(table, missing)


def read_metrics(file: Path, remedy: str = "validate the run again") -> dict[str, Any]:
    """Read a ``metrics.json``; `remedy` says what to do if that fails.

    Raises
    ------
    CpunetError
        If the file cannot be read or does not contain the scores of a validation.
    """
    content = read_json(file, remedy)
    if not isinstance(content.get("peaks"), dict):
        raise CpunetError(f"{file}: holds no scores by peak; give a report of cpunet validate")
    return content


def _metrics_file(report: Path, *, missing_ok: bool) -> Path | None:
    """Path of the metrics of a report, given as folder or file; None if it may be missing."""
    if report.is_dir():
        for file in (report / METRICS, report / REPORT / METRICS):
            if file.is_file():
                return file
        if missing_ok:
            return None
        raise CpunetError(
            f"{report}: no {METRICS} in it; give a folder of cpunet validate or cpunet demo, "
            "or --missing-ok"
        )
    if not report.exists():
        if missing_ok:
            return None
        raise CpunetError(f"{report}: no such folder or file; give a folder of cpunet validate")
    return report


def _names(reports: Sequence[Path]) -> list[str]:
    """Name each report by its folder, with as many parent folders as make it unique.

    Folders at the end that all reports share, such as ``report``, are left out.
    """
    given = [report.resolve() for report in reports]
    parts = [(path.parent if path.is_file() else path).parts for path in given]
    while len(set(parts)) == len(parts) > 1 and len({part[-1] for part in parts}) == 1:
        parts = [part[:-1] for part in parts]
    longest = max(map(len, parts), default=1)
    names: list[str] = []
    for depth in range(1, longest + 1):
        names = [str(Path(*part[-depth:])) for part in parts]
        if len(set(names)) == len(names):
            return names
    # names that are still equal refer to the same report
    return [f"{Path(name).name} ({i})" for i, name in enumerate(names, start=1)]
