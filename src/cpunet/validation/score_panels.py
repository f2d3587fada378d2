"""The scores of a report as forest plots: every method beside its ceiling, with errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from markupsafe import Markup

from cpunet.html_pages import part
from cpunet.plotting import NO_NOISE, label
from cpunet.pulses.parameters import PARAMETERS
from cpunet.validation.forest_plot import forest_plot
from cpunet.validation.side_by_side import Cell, Row

LAST = "ren"  # drawn last; the other methods are in the order of the tables


def score_panels(peak: str, scores: Mapping[str, Any]) -> Markup:
    """Return a forest plot for the IoU of each parameter, and one for the classifier.

    Parameters
    ----------
    peak
        Name of the gamma line.
    scores
        Scores of the peak, as in ``metrics.json``.

    Returns
    -------
    Markup
        Empty if the peak is not scored.
    """
    return part(
        "grid",
        "panels",
        [
            forest_plot(row, list(map(label, methods)), methods=methods)
            for row, methods in _rows(peak, scores)
        ],
    )


def _rows(peak: str, scores: Mapping[str, Any]) -> Iterator[tuple[Row, list[str]]]:
    parameters = scores.get("parameters", {})
    for name in (name for name in PARAMETERS if name in parameters):
        found = parameters[name]
        iou, error = found["iou"], found.get("iou_std", {})
        cells = {
            method: _cell(value, error.get(method), iou.get("ceiling"), error.get("ceiling"))
            for method, value in _in_order(iou)
            if method != "ceiling"
        }
        title = name.replace("_", " ")
        yield from _row(peak, f"IoU of the {title} [%]; grey: the ceiling", cells)
    cells = {
        method: _cell(found["auc"], found["auc_std"], found["null_mean"], found["null_std"])
        for method, found in _in_order(scores.get("two_sample") or {})
        if "auc" in found
    }
    yield from _row(peak, "AUC of a classifier, method against data; grey: by chance", cells)


def _row(peak: str, score: str, cells: Mapping[str, Cell]) -> Iterator[tuple[Row, list[str]]]:
    if any(cell.value is not None for cell in cells.values()):
        row = Row(peak, score, tuple(cells.values()), frozenset())
        yield row, list(cells)


def _in_order(found: Mapping[str, Any]) -> list[tuple[str, Any]]:
    noisy = [(method, one) for method, one in found.items() if not method.endswith(NO_NOISE)]
    return sorted(noisy, key=lambda pair: pair[0] == LAST)


def _cell(
    value: float | None, error: float | None, expected: float | None, spread: float | None
) -> Cell:
    if value is None:
        return Cell()
    text = f"{value:.3g}" + (f" ± {error:.2g}" if error is not None else "")
    return Cell(text, value, error, expected, spread)
