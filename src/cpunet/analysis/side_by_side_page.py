"""The comparison of several runs as one page: a table, and a forest plot per score."""

from __future__ import annotations

from cpunet.analysis.forest_plot import forest_plot
from cpunet.analysis.html_pages import rendered
from cpunet.analysis.side_by_side import SideBySide
from cpunet.analysis.style import label


def side_by_side_page(table: SideBySide) -> str:
    """Return the comparison as self-contained HTML.

    Parameters
    ----------
    table
        Result of `side_by_side`.
    """
    return rendered(
        "compare.html",
        title=f"{label(table.method)}: {len(table.names)} runs compared",
        table=table,
        panels=[forest_plot(row, table.names) for row in table.rows],
    )
