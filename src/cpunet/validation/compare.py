"""Compare the scores of several validations."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from urllib.parse import quote

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_existing, written_aside
from cpunet.tables import text_table
from cpunet.validation.report import METRICS, PAGE, Report, read_metrics
from cpunet.validation.side_by_side import FEW, SideBySide, comparison_page, side_by_side
from cpunet.validation.verdicts import Metrics


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Scores of several runs, as returned by `cpunet.compare`.

    Parameters
    ----------
    table
        Scores of the runs, which have the names of their folders, made unique, such as
        ``DETECTOR/PERIOD``.
    metrics
        Content of ``metrics.json`` by run.
    folders
        Folder of each report; None for those in memory.
    missing
        Names of the reports that are not there.
    path
        The page; None if none was written.
    """

    table: SideBySide
    metrics: Mapping[str, Metrics]
    folders: Mapping[str, Path | None]
    missing: tuple[str, ...] = ()
    path: Path | None = None

    def save(self, path: str | Path, force: bool = False) -> None:
        """Write the comparison as an HTML page, with links to the reports.

        Raises
        ------
        CpunetError
            If the page exists and `force` is off, or cannot be written.
        """
        path = Path(path)
        _refuse(path, [*self.folders.values()], force=force)
        links = {
            name: quote(os.path.relpath(folder / PAGE, path.parent))
            for name, folder in self.folders.items()
            if folder is not None and (folder / PAGE).is_file()
        }
        page = comparison_page(self.table, self.metrics, links, self.missing)
        with written_aside(path) as aside:
            aside.write_text(page, encoding="utf-8")

    def __str__(self) -> str:
        table, lines = self.table, []
        if self.path is None or len(table.names) <= FEW:
            lines.append(_text(table, f"Scores of {table.method}, the best with *"))
            lines += [f"note: {note}" for note in table.notes]
        if table.over_runs is not None:
            title = "Over runs: median ± standard deviation (lowest – highest)"
            lines.append(_text(table.over_runs, title))
        lines += [f"no report: {name}" for name in self.missing]
        return "\n".join(lines if self.path is None else [*lines, str(self.path)])

    def __repr__(self) -> str:
        return f"<Comparison of {', '.join(self.table.names)}: {self.table.method}>"


def compare(
    *reports: str | Path | Report,
    method: str = "ren",
    out: str | Path | None = None,
    force: bool = False,
) -> Comparison:
    """Put the scores of several validations beside each other, of one detector or of many.

    The page also has links to the reports, and room for many detectors and periods. A second
    table tells how the scores of runs scatter that differ in their seed only. Reports that are
    missing are listed.

    Parameters
    ----------
    reports
        Folders of cpunet validate or demo, or their metrics.json.
    method
        Whose scores: ren, raw, rc, gauss_exp, superpulse, truth.
    out
        Page to write, such as compare.html.
    force
        Replace existing output.

    Returns
    -------
    Comparison
        Scores of the runs side by side.

    Raises
    ------
    CpunetError
        If a report cannot be read, all are missing, none has a score of `method`, or `out`
        exists or is not writable.

    Examples
    --------
    cpunet compare report1 report2 --out compare.html

    cpunet compare results/*/*/report --out results/index.html
    """
    if out is None:
        return compared(reports, method=method)
    files = [r.folder if isinstance(r, Report) else Path(r) for r in reports]
    _refuse(Path(out), files, force=force)
    comparison = compared(reports, method=method)
    comparison.save(out, force=force)
    return replace(comparison, path=Path(out))


def compared(
    reports: Sequence[str | Path | Report],
    *,
    method: str = "ren",
    failed: Collection[Path] = (),
) -> Comparison:
    """Compare the scores of several validations, see `compare`.

    Parameters
    ----------
    reports, method
        As of `compare`.
    failed
        Reports to list as missing: what is in their folders is of an earlier validation.
    """
    places: list[Path] = []
    metrics: list[Metrics | None] = []
    folders: list[Path | None] = []
    for report in reports:
        if isinstance(report, Report):
            # one in memory is named by its run
            places.append(report.folder or Path(report.metrics["compared"]["run"]))
            metrics.append(report.to_dict())
            folders.append(report.folder)
            continue
        path = Path(report)
        files = (path, path / METRICS, path / "report" / METRICS)  # the last one of a demo
        file = next((f for f in files if f.is_file() and path not in failed), None)
        places.append(path)
        metrics.append(read_metrics(file) if file else None)
        folders.append(file and file.parent)
    names = _names(places)
    runs = {n: found for n, found in zip(names, metrics, strict=True) if found is not None}
    if not runs:
        raise CpunetError(
            f"none of the {len(reports)} reports is there",
            "give folders of cpunet validate or cpunet demo",
        )
    missing = tuple(name for name in names if name not in runs)
    table = side_by_side(runs, method)
    return Comparison(table, runs, dict(zip(names, folders, strict=True)), missing)


def _refuse(out: Path, reports: Sequence[Path | None], *, force: bool) -> None:
    if out.is_dir():
        raise CpunetError(f"{out}: is a folder", "give the name of a page, as compare.html")
    refuse_existing(out, *reports, force=force)


def _text(table: SideBySide, title: str) -> str:
    """A row per peak and score, a column per run."""
    rows = []
    for peak, of_peak in groupby(table.rows, key=lambda row: row.peak):
        names = [peak]
        for row in of_peak:
            cells = [f"{c.text}{'*' * (i in row.best)}" for i, c in enumerate(row.cells)]
            rows.append([names.pop() if names else "", row.score, *cells])
    return text_table(["peak", "score", *table.names], rows, words=2, title=title)


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
