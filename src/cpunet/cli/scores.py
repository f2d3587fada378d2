"""The table of scores that commands print."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from cpunet.cli.messages import tell

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


def print_scores(metrics: dict[str, Any], leave_out: Sequence[str] = ()) -> None:
    """Print the table of scores, and below it why peaks have none."""
    tell(score_table(metrics, leave_out))
    for peak, scores in metrics["peaks"].items():
        if "missing" in scores and peak not in leave_out:
            tell(f"{peak}: not scored, {scores['missing']}")


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
        table.add_column(column)
    for method in shown:
        table.add_column(METHODS[method], justify="right")
    for peak, scores in peaks.items():
        for parameter, comparison in scores["parameters"].items():
            cells = [_number(comparison["iou"].get(m)) for m in shown]
            table.add_row(peak, PARAMETERS.get(parameter, parameter), *cells)
    return table


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"
