"""Scores of many detectors and periods as one page: overview, forest plots, verdicts.

The page is self-contained; its links lead to the individual reports.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cpunet.analysis.forest_plot import forest_plot
from cpunet.analysis.html_pages import rendered
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
    with_scores = [entry for entry in entries if entry.metrics is not None]
    return rendered(
        "summary.html",
        title="REN translations by detector and period",
        entries=entries,
        scored=len(scored),
        missing=[entry.name for entry in entries if entry.metrics is None],
        periods=(periods := list(dict.fromkeys(entry.period for entry in entries))),
        overview=_overview(entries, periods),
        panels=_panels(rows, with_scores),
        words=[(entry, *_in_words(entry.metrics or {})) for entry in with_scores],
    )


def _overview(
    entries: Sequence[Entry], periods: Sequence[str]
) -> dict[str, list[dict[str, Any]]]:
    """By detector, a cell for each period: number of scores off, and the report."""
    found = {(entry.detector, entry.period): entry for entry in entries}
    return {
        detector: [_cell(found.get((detector, period))) for period in periods]
        for detector in dict.fromkeys(entry.detector for entry in entries)
    }


def _cell(entry: Entry | None) -> dict[str, Any]:
    off, judged = judged_scores((entry and entry.metrics) or {}, METHOD)
    # one or two scores can be off by chance
    marked = off > 2 and off > 0.2 * judged
    text = f"{off} of {judged} off" if judged else "not judged"
    return {"entry": entry, "text": text, "marked": marked}


def _panels(rows: Sequence[Row], entries: Sequence[Entry]) -> dict[str, list[str]]:
    """By peak, a forest plot per score."""
    names = [entry.name for entry in entries]
    detectors = [entry.detector for entry in entries]
    starts = [i for i, name in enumerate(detectors) if i and name != detectors[i - 1]]
    return {
        peak: [forest_plot(row, names, starts) for row in rows if row.peak == peak]
        for peak in dict.fromkeys(row.peak for row in rows)
    }


def _in_words(metrics: Mapping[str, Any]) -> tuple[str, list[str]]:
    """How the network was trained, and the verdict on each peak."""
    training = part(metrics, "training")
    known = [
        f"{words} {training[key]}"
        for key, words in (("recipe", "recipe"), ("peak", "trained on"), ("device", "on"))
        if isinstance(training.get(key), (str, int, float))
    ]
    return ", ".join(known), [summary(metrics, peak, METHOD) for peak in part(metrics, "peaks")]
