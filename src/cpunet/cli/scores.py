"""The table of scores that commands print."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

# Methods in the order of a report; those without noise are in metrics.json.
METHODS = {
    "raw": "raw",
    "rc": "rc",
    "gauss_exp": "gauss_exp",
    "superpulse": "superpulse",
    "ren": "REN",
    "truth": "truth",
    "ceiling": "ceiling",
}
PARAMETERS = {
    "current_amplitude": "I_max",
    "drift_time": "T_drift",
    "tail_slope": "tail slope",
}


def score_table(metrics: dict[str, Any], leave_out: Sequence[str] = ()) -> Table:
    """Draw IoU by peak, parameter and method, in percent.

    Parameters
    ----------
    metrics
        The content of ``metrics.json``.
    leave_out
        Peaks that are not shown.
    """
    peaks = {name: p for name, p in metrics["peaks"].items() if name not in leave_out}
    scored = {
        method
        for peak in peaks.values()
        for comparison in peak["parameters"].values()
        for method in comparison["iou"]
    }
    shown = [m for m in METHODS if m in scored]
    table = Table(title="Overlap with data (IoU, %)", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("peak", "parameter"):
        table.add_column(column, no_wrap=True)
    for method in shown:
        table.add_column(METHODS[method], justify="right", no_wrap=True)
    for peak, scores in peaks.items():
        if "missing" in scores:
            table.add_row(peak, scores["missing"], *("" for _ in shown))
        for parameter, comparison in scores["parameters"].items():
            cells = [_number(comparison["iou"].get(m)) for m in shown]
            table.add_row(peak, PARAMETERS.get(parameter, parameter), *cells)
    return table


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"
