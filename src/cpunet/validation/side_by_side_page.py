"""The comparison of several runs as one page: how each fares, a table, forest plots."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from cpunet.html_pages import rendered
from cpunet.plotting import label
from cpunet.validation.forest_plot import forest_plot
from cpunet.validation.side_by_side import FEW, Metrics, SideBySide
from cpunet.validation.verdicts import judged_scores, part, summary


def side_by_side_page(
    table: SideBySide,
    runs: Mapping[str, Metrics],
    links: Mapping[str, str] | None = None,
    missing: Collection[str] = (),
) -> str:
    """Return the comparison as self-contained HTML.

    Parameters
    ----------
    table
        Result of `side_by_side`.
    runs
        Content of ``metrics.json`` by the name of the run.
    links
        Address of the report of each run, if there is one.
    missing
        Names of the runs that have no report.
    """
    groups = [name.rpartition("/")[0] for name in table.names]  # as DETECTOR/PERIOD
    starts = [i for i in range(1, len(groups)) if groups[i] != groups[i - 1]]
    peaks = dict.fromkeys(row.peak for row in table.rows)
    return rendered(
        "compare.html",
        title=f"{label(table.method)}: {len(table.names)} runs compared",
        table=table,
        few=len(table.names) <= FEW,
        overview=[_overview(name, runs[name], table.method) for name in table.names],
        links=links or {},
        missing=missing,
        panels={
            peak: [forest_plot(r, table.names, starts) for r in table.rows if r.peak == peak]
            for peak in peaks
        },
    )


def _overview(name: str, metrics: Metrics, method: str) -> dict[str, Any]:
    """Line of one run: how many scores are off, how it was trained, verdicts in words."""
    off, judged = judged_scores(metrics, method)
    training = part(metrics, "training")
    known = [
        f"{words} {training[key]}"
        for key, words in (("recipe", "recipe"), ("peak", "trained on"), ("device", "on"))
        if isinstance(training.get(key), (str, int, float))
    ]
    return {
        "name": name,
        "text": f"{off} of {judged} off" if judged else "not judged",
        "marked": off > 2 and off > 0.2 * judged,  # one or two can be off by chance
        "about": ", ".join(known),
        "lines": [summary(metrics, peak, method) for peak in part(metrics, "peaks")],
    }
