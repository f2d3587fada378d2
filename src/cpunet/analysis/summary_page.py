"""Scores of many detectors and periods as one page: overview, forest plots, verdicts.

The page is self-contained; its links lead to the individual reports.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from cpunet.analysis.forest_plot import forest_plot
from cpunet.analysis.side_by_side import Row, side_by_side
from cpunet.analysis.verdicts import judged_scores, part, summary

METHOD = "ren"
_NAMES_APART = " · "


@dataclass(frozen=True)
class Entry:
    """The validation of one detector in one period.

    Attributes
    ----------
    detector, period
        Names of the detector and the period.
    metrics
        Content of ``metrics.json``; None if there is no report.
    link
        Path of ``report.html`` relative to the page; None if there is none.
    """

    detector: str
    period: str
    metrics: Mapping[str, Any] | None = field(default=None, repr=False)
    link: str | None = None

    @property
    def name(self) -> str:
        """Detector and period as one name."""
        return f"{self.detector}{_NAMES_APART}{self.period}"


def summary_page(entries: Sequence[Entry]) -> str:
    """Return the page as self-contained HTML.

    Parameters
    ----------
    entries
        Validations, each of a different detector or period, in the order of display.  At
        least one has metrics.

    Raises
    ------
    CpunetError
        If none of them has a score of the REN.
    """
    scored = {e.name: e.metrics for e in entries if e.metrics is not None}
    rows = side_by_side(scored, METHOD).rows
    periods = list(dict.fromkeys(entry.period for entry in entries))
    missing = [entry.name for entry in entries if entry.metrics is None]
    page = files("cpunet.analysis").joinpath("summary_page.html").read_text(encoding="utf-8")
    return Template(page).substitute(
        count=f"{len(scored)} of {len(entries)} reports",
        missing=_missing(missing),
        periods="".join(f'<th scope="col">{escape(period)}</th>' for period in periods),
        overview="\n".join(_overview(entries, periods)),
        panels="\n".join(_panels(rows, [e for e in entries if e.metrics is not None])),
        words="\n".join(_in_words(entry) for entry in entries if entry.metrics is not None),
    )


def _missing(names: Sequence[str]) -> str:
    if not names:
        return ""
    listed = ", ".join(map(escape, names))
    return f'<p class="missing"><strong>No report:</strong> {listed}.</p>'


def _overview(entries: Sequence[Entry], periods: Sequence[str]) -> list[str]:
    """One row per detector, one cell per period: number of scores off, and the report."""
    found = {(entry.detector, entry.period): entry for entry in entries}
    lines = []
    for detector in dict.fromkeys(entry.detector for entry in entries):
        cells = [_cell(found.get((detector, period))) for period in periods]
        lines.append(f'<tr><th scope="row">{escape(detector)}</th>{"".join(cells)}</tr>')
    return lines


def _cell(entry: Entry | None) -> str:
    if entry is None:
        return "<td>–</td>"
    if entry.metrics is None:
        return '<td class="missing">no report</td>'
    off, judged = judged_scores(entry.metrics, METHOD)
    text = f"{off} of {judged} off" if judged else "not judged"
    # one or two scores can be off by chance
    marked = ' class="off"' if off > 2 and off > 0.2 * judged else ""
    return f"<td{marked}>{_linked(entry, text)}</td>"


def _panels(rows: Sequence[Row], entries: Sequence[Entry]) -> list[str]:
    """A heading per peak, and a forest plot per score."""
    names = [entry.name for entry in entries]
    detectors = [entry.detector for entry in entries]
    starts = [i for i, name in enumerate(detectors) if i and name != detectors[i - 1]]
    lines = []
    for peak in dict.fromkeys(row.peak for row in rows):
        panels = [forest_plot(row, names, starts) for row in rows if row.peak == peak]
        lines.append(f'<h3>{escape(peak)}</h3>\n<div class="panels">')
        lines += [*panels, "</div>"]
    return lines


def _in_words(entry: Entry) -> str:
    metrics = entry.metrics or {}
    training = part(metrics, "training")
    known = [
        f"{words} {training[key]}"
        for key, words in (("recipe", "recipe"), ("peak", "trained on"), ("device", "on"))
        if isinstance(training.get(key), (str, int, float))
    ]
    lines = "".join(
        f"<li>{escape(summary(metrics, peak, METHOD))}</li>" for peak in part(metrics, "peaks")
    )
    about = f' <span class="about">{escape(", ".join(known))}</span>' if known else ""
    return f"<dt>{_linked(entry, entry.name)}{about}</dt>\n<dd><ul>{lines}</ul></dd>"


def _linked(entry: Entry, text: str) -> str:
    if entry.link is None:
        return escape(text)
    return f'<a href="{escape(entry.link, quote=True)}">{escape(text)}</a>'
