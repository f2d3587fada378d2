"""Scores of several methods or validations as dots beside what chance gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cpunet.plotting import GROUP, colours, label, panels, styled
from cpunet.tables import NO_VALUE

COLUMNS = 4  # panels in a line; of more than one line, 3
LONGEST = 23  # maximum characters of a name


@dataclass(frozen=True)
class Cell:
    """A score with its error, and its expectation by chance with the spread.

    Attributes
    ----------
    text
        Score as displayed, with error and ceiling.
    value
        Score; None where there is none.
    digits
        Format of the score.
    """

    text: str = NO_VALUE
    value: float | None = None
    error: float | None = None
    expected: float | None = None
    expected_std: float | None = None
    digits: str = ""


@dataclass(frozen=True)
class Row:
    """One score of every method or run.

    Attributes
    ----------
    peak, score
        Name of the peak and of the score.
    cells
        Scores in the order of the runs.
    best
        Indices of the runs with the best score; empty if fewer than two have a score.
    """

    peak: str
    score: str
    cells: tuple[Cell, ...]
    best: frozenset[int] = frozenset()


@styled
def score_figure(
    rows: Sequence[Row],
    names: Sequence[str],
    starts: Sequence[int] = (),
    methods: Sequence[str] = (),
) -> Figure:
    """Draw each score with its error in a panel; grey is the expectation by chance.

    Parameters
    ----------
    rows
        Scores.
    names
        Names of the methods or runs.
    starts
        Indices at which groups of them begin; a line is drawn above each.
    methods
        Methods, if they differ; otherwise all are REN translations.
    """
    columns = len(rows) if len(rows) <= COLUMNS else COLUMNS - 1
    methods = methods or ["ren"] * len(names)
    lines, palette = -(-len(rows) // columns), colours(methods)
    short = [n if len(n) <= LONGEST else f"…{n[1 - LONGEST :]}" for n in names]
    figure, grid = panels(
        (1.6 + 2.4 * columns, lines * (0.9 + 0.18 * len(names))),
        lines,
        columns,
        left=0.2 + 0.085 * max(map(len, short)),
        top=0.15,
        between=(0.2, 0.6),
        sharey=True,
    )
    places = grid.flat
    for row, axes in zip(rows, places, strict=False):
        for place, (cell, method) in enumerate(zip(row.cells, methods, strict=True)):
            if cell.value is None:
                where = axes.get_yaxis_transform()
                axes.text(0.02, place, "no score", transform=where, va="center", color="0.5")
                continue
            if cell.expected is not None:
                spread = cell.expected_std or 0
                band = cell.expected - spread, cell.expected + spread
                axes.plot(band, [place] * 2, color="0.87", lw=9, solid_capstyle="butt")
                axes.plot([cell.expected] * 2, [place - 0.4, place + 0.4], color="0.5", lw=1)
            error = cell.error or 0
            bar = cell.value - error, cell.value, cell.value + error
            look = {"marker": "o", "markevery": [1], "markersize": 4, "color": palette[method]}
            axes.plot(bar, [place] * 3, gid=GROUP + method, **look)
        for start in starts:
            axes.axhline(start - 0.5, color="0.87", lw=0.8)
        axes.set(xlabel=row.score, ylim=(len(names) - 0.5, -0.5))
    axes.set_yticks(np.arange(len(names)), short, parse_math=False)
    for empty in places:
        empty.set_axis_off()
    return figure


def peak_figure(peak: str, scores: Mapping[str, Any]) -> Figure:
    """Draw the IoU of each parameter of a peak, and the AUC of the classifier, by method."""
    tested = scores["two_sample"]
    methods = [m for m in tested if m != "ren"] + ["ren"]
    rows = [
        Row(
            peak,
            f"IoU of the {name.replace('_', ' ')} [%]",
            tuple(
                Cell("", iou.get(m), error.get(m), iou["ceiling"], error["ceiling"])
                for m in methods
            ),
        )
        for name, found in scores["parameters"].items()
        for iou, error in [(found["iou"], found["iou_std"])]
    ]
    keys = ("auc", "auc_std", "null_mean", "null_std")
    cells = (Cell("", *(tested[m].get(key) for key in keys)) for m in methods)
    rows.append(Row(peak, "AUC of a classifier against data", tuple(cells)))
    return score_figure(rows, list(map(label, methods)), methods=methods)
