"""``cpunet compare``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from cpunet.cli import options
from cpunet.cli.messages import tell

if TYPE_CHECKING:
    from cpunet.validation.side_by_side import SideBySide

Reports = Annotated[
    list[Path], typer.Argument(help="Folders of cpunet validate or demo, or metrics.json.")
]
Out = Annotated[Path | None, typer.Option("--out", help="Page to write, such as compare.html.")]
MissingOk = Annotated[
    bool, typer.Option("--missing-ok", help="List reports that are not there; no error.")
]
Method = Annotated[
    str, typer.Option(help="Whose scores: ren, raw, rc, gauss_exp, superpulse, truth.")
]


def compare(
    reports: Reports,
    out_file: Out = None,
    method: Method = "ren",
    missing_ok: MissingOk = False,
    force: options.Force = False,
) -> None:
    """Put the scores of several validations beside each other, best in bold.

    The page also has links to the reports, and room for many detectors and periods. A second
    table tells how the scores of runs scatter that differ in their seed only.

    Example: cpunet compare report1 report2 --out compare.html

    Example: cpunet compare results/*/*/report --out results/index.html
    """
    from cpunet.jobs.validation.compare import compare_reports
    from cpunet.validation.side_by_side_page import FEW

    table, missing = compare_reports(
        reports, method=method, out=out_file, missing_ok=missing_ok, force=force
    )
    if out_file is None or len(table.names) <= FEW:
        tell(comparison_table(table, f"Scores of {escape(table.method)}"))
        for note in table.notes:
            tell(f"note: {note}")
    if table.over_runs is not None:
        title = "Over runs: median ± standard deviation (lowest – highest)"
        tell(comparison_table(table.over_runs, title))
    for name in missing:
        tell(f"no report: {name}")
    if out_file is not None:
        tell(str(out_file))


def comparison_table(compared: SideBySide, title: str) -> Table:
    """Draw a row per peak and score, a column per run.

    Parameters
    ----------
    compared
        See `cpunet.validation.side_by_side.side_by_side`.
    title
        Title of the table.
    """
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("peak", "score"):
        table.add_column(column)
    for name in compared.names:
        table.add_column(escape(name), justify="right")
    peak = None
    for row in compared.rows:
        cells = [
            f"[bold]{cell.text}[/]" if i in row.best else cell.text
            for i, cell in enumerate(row.cells)
        ]
        table.add_row("" if row.peak == peak else escape(row.peak), escape(row.score), *cells)
        peak = row.peak
    return table
