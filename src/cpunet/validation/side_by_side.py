"""Scores of several validations as rows of one table and as a page."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from cpunet.errors import CpunetError
from cpunet.plotting import GROUP, colours, label, panels, styled
from cpunet.tables import NO_VALUE
from cpunet.validation.verdicts import (
    Metrics,
    judged_scores,
    methods_of,
    number,
    part,
    summary,
)

FEW = 8  # runs whose scores fit beside each other; more have an overview and panels
CEILING = " (ceiling)"
AUC = ("auc", "auc_std", "null_mean", "null_std")
COLUMNS = 4  # panels in a line; of more than one line, 3
LONGEST = 23  # maximum characters of a name


@dataclass(frozen=True)
class Cell:
    """A score with its error, and its expectation by chance with the spread.

    Attributes
    ----------
    digits
        Format of the score.
    value
        Score; None where there is none.
    appended
        Text that follows it.
    """

    digits: str = ""
    value: float | None = None
    error: float | None = None
    expected: float | None = None
    expected_std: float | None = None
    appended: str = field(default="", kw_only=True)

    @property
    def text(self) -> str:
        """Score as displayed."""
        if self.value is None:
            return NO_VALUE
        error = "" if self.error is None else f" ± {self.error:{self.digits.lstrip('+')}}"
        return f"{self.value:{self.digits}}{error}{self.appended}"


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


def peak_figure(peak: str, scores: Metrics) -> Figure:
    """Draw the IoU of each parameter of a peak, and the AUC of the classifier, by method."""
    methods = [m for m in scores["two_sample"] if m != "ren"] + ["ren"]
    rows = _score_rows(peak, [(scores, method) for method in methods])
    rows = [replace(row, score=row.score.removesuffix(CEILING)) for row in rows]
    return score_figure(rows, list(map(label, methods)), methods=methods)


@dataclass(frozen=True)
class SideBySide:
    """Scores of several runs, side by side.

    Attributes
    ----------
    names
        Names of the runs.
    method
        Method that is scored.
    rows
        Scores, ordered by peak.
    notes
        Reasons to doubt the comparison, one sentence each.
    compared
        Inputs and origin of the runs (files, detector, period, quality of the fit) by name;
        texts in the order of the runs.
    over_runs
        If several runs differ in the seed only: their median, standard deviation, lowest and
        highest score, with a name and a cell for all of them.
    """

    names: tuple[str, ...]
    method: str
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    compared: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    over_runs: SideBySide | None = None


def side_by_side(runs: Mapping[str, Metrics], method: str = "ren") -> SideBySide:
    """Put the scores of several runs side by side.

    Parameters
    ----------
    runs
        Content of ``metrics.json`` by the name of the run.
    method
        Method that is scored: ``ren``, ``raw``, a baseline method or ``truth``.

    Returns
    -------
    SideBySide
        The best is the highest IoU, the AUC closest to that of shuffled labels, the lowest
        RMSE of the edge, and the smallest difference of A/E survival.

    Raises
    ------
    CpunetError
        If no run has a score of the method.

    Examples
    --------
    >>> iou = lambda value: {"iou": {"ren": value, "ceiling": 90.0}}
    >>> metrics = lambda v: {"peaks": {"SEP": {"parameters": {"drift_time": iou(v)}}}}
    >>> table = side_by_side({"old": metrics(80.0), "new": metrics(85.0)})
    >>> [cell.text for cell in table.rows[0].cells], table.rows[0].best
    (['80.0 (90.0)', '85.0 (90.0)'], frozenset({1}))
    """
    rows = [
        row
        for peak in _union(part(metrics, "peaks") for metrics in runs.values())
        for row in _peak_rows(peak, list(runs.values()), method)
    ]
    if not rows:
        known = _union(methods_of(m, peak) for m in runs.values() for peak in part(m, "peaks"))
        raise CpunetError(
            f"{', '.join(runs)}: no score of the method {method}; "
            + (f"there are {', '.join(known)}" if known else "nothing is scored there")
        )
    inputs = [part(metrics, "compared") for metrics in runs.values()]
    compared = {n: tuple(str(one.get(n, NO_VALUE)) for one in inputs) for n in _union(inputs)}
    over_runs = _over_runs(list(runs.values()), method, rows)
    return SideBySide(
        tuple(runs), method, tuple(rows), tuple(_notes(runs)), compared, over_runs
    )


def comparison_page(
    table: SideBySide,
    runs: Mapping[str, Metrics],
    links: Mapping[str, str],
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
    # matplotlib, with the page, takes longer than to print a table
    from cpunet.html_pages import figure_html, rendered

    groups = [name.rpartition("/")[0] for name in table.names]  # as DETECTOR/PERIOD
    starts = [i for i in range(1, len(groups)) if groups[i] != groups[i - 1]]
    peaks = {row.peak: [r for r in table.rows if r.peak == row.peak] for row in table.rows}
    return rendered(
        "compare.html",
        title=f"{label(table.method)}: {len(table.names)} runs compared",
        table=table,
        few=len(table.names) <= FEW,
        overview=[_overview(name, runs[name], table.method) for name in table.names],
        links=links,
        missing=missing,
        panels=[
            figure_html(f"{peak} scores", score_figure(rows, table.names, starts))
            for peak, rows in peaks.items()
        ],
    )


class Overview(NamedTuple):
    """Line of one run: how many scores are off, how it was trained, verdicts in words."""

    name: str
    text: str
    marked: bool
    about: str
    lines: list[str]


def _overview(name: str, metrics: Metrics, method: str) -> Overview:
    off, judged = judged_scores(metrics, method)
    training = part(metrics, "training")
    known = [
        f"{words} {training[key]}"
        for key, words in (("recipe", "recipe"), ("peak", "trained on"), ("device", "on"))
        if isinstance(training.get(key), (str, int, float))
    ]
    text = f"{off} of {judged} off" if judged else "not judged"
    marked = off > 2 and off > 0.2 * judged  # one or two can be off by chance
    lines = [summary(metrics, peak, method) for peak in part(metrics, "peaks")]
    return Overview(name, text, marked, ", ".join(known), lines)


def _over_runs(runs: Sequence[Metrics], method: str, rows: Sequence[Row]) -> SideBySide | None:
    """Scores over the runs of the same recipe, energies and files; None without such runs."""
    alike: dict[str, list[int]] = {}
    for i, metrics in enumerate(runs):
        training, compared = part(metrics, "training"), part(metrics, "compared")
        origin = [training.get(key) for key in ("recipe", "peak")]
        origin += [compared.get(key) for key in ("simulation", "data")]
        if training:
            alike.setdefault(", ".join(map(str, filter(None, origin))), []).append(i)
    alike = {origin: members for origin, members in alike.items() if len(members) > 1}
    if not alike:
        return None
    names = tuple(f"{len(members)} runs of {origin}" for origin, members in alike.items())
    over = []
    for row in rows:
        cells = [_over([row.cells[i] for i in members]) for members in alike.values()]
        name = row.score.removesuffix(CEILING)
        over.append(Row(row.peak, name, tuple(cells), frozenset()))
    return SideBySide(names, method, tuple(over), ())


def _over(cells: Sequence[Cell]) -> Cell:
    """Median, standard deviation, lowest and highest of a score, and how many runs lack it."""
    known = [cell for cell in cells if cell.value is not None]
    if len(known) < 2:
        return Cell()
    values, digits = np.array([cell.value for cell in known], float), known[0].digits
    median, spread = float(np.median(values)), float(np.std(values, ddof=1))
    appended = f" ({values.min():{digits}} – {values.max():{digits}})"
    if missing := len(cells) - len(known):
        appended += f", {missing} missing"
    return Cell(digits, median, spread, appended=appended)


def _score_rows(peak: str, found: Sequence[tuple[Metrics, str]]) -> list[Row]:
    """IoU of each parameter and AUC of the classifier, of methods in scores of a peak."""
    rows = []
    for name in _union(part(scores, "parameters") for scores, _ in found):
        cells = []
        for scores, method in found:
            one = part(scores, "parameters", name)
            value, ceiling = (number(one, "iou", key) for key in (method, "ceiling"))
            error, spread = (number(one, "iou_std", key) for key in (method, "ceiling"))
            appended = f" ({ceiling:.1f})" if ceiling is not None else ""
            cells.append(Cell(".1f", value, error, ceiling, spread, appended=appended))
        title = f"{name.replace('_', ' ')}: IoU [%]{CEILING}"
        rows.append(_row(peak, title, cells, lambda c: -(c.value or 0.0)))
    cells = [Cell(".3f", *(number(s, "two_sample", m, key) for key in AUC)) for s, m in found]
    return [*rows, _row(peak, "classifier: AUC", cells, _off)]


def _peak_rows(peak: str, runs: Sequence[Metrics], method: str) -> list[Row]:
    """Rows of one peak in which any run has a value."""
    scores = [part(metrics, "peaks", peak) for metrics in runs]
    rows = _score_rows(peak, [(one, method) for one in scores])
    edges = (number(s, "paired", method, "edge_rmse") for s in scores)
    cells = [Cell("#.3g", None if edge is None else 1e3 * edge) for edge in edges]
    rows.append(_row(peak, "edge RMSE [10⁻³]", cells, _off))
    survival = [part(metrics, "ae_survival", peak) for metrics in runs]
    cells = [
        Cell("+.2f", number(s, "difference", method), number(s, "difference_std", method), 0.0)
        for s in survival
    ]
    rows.append(_row(peak, "A/E survival minus data [points]", cells, _off))
    return [row for row in rows if any(cell.value is not None for cell in row.cells)]


def _row(peak: str, score: str, cells: Sequence[Cell], badness: Callable[[Cell], float]) -> Row:
    known = {i: badness(cell) for i, cell in enumerate(cells) if cell.value is not None}
    best = min(known.values(), default=0.0)
    winners = frozenset(i for i, bad in known.items() if bad == best)
    return Row(peak, score, tuple(cells), winners if len(known) > 1 else frozenset())


def _off(cell: Cell) -> float:
    return abs((cell.value or 0.0) - (cell.expected or 0.0))


def _notes(runs: Mapping[str, Metrics]) -> list[str]:
    """Signs that the runs were not scored on the same pulses."""
    first, *others = runs
    found: dict[str, list[str]] = {}
    for other in others:
        one, two = (part(runs[name], "compared").get("detector") for name in (first, other))
        if one and two and one != two:
            words = f"are of different detectors, {one} and {two}."
            found.setdefault(words, []).append(other)
        if apart := _differences(runs[first], runs[other]):
            words = f"were scored on different pulses ({', '.join(apart)}): their scores "
            found.setdefault(f"{words}differ for that reason, too.", []).append(other)
    return [
        f"{first} and {names[0]} {words}"
        if len(names) == 1
        else f"{first} on one side, {', '.join(names)} on the other {words}"
        for words, names in found.items()
    ]


def _differences(one: Metrics, other: Metrics) -> list[str]:
    a, b = (part(metrics, "peaks") for metrics in (one, other))
    both = a.keys() & b.keys()
    apart = ["peaks"] if a.keys() != b.keys() else []
    for side, called in (("data", "measured"), ("sim", "simulated")):
        n = f"n_{side}"
        if any(part(a, peak).get(n) != part(b, peak).get(n) for peak in both):
            apart.append(f"number of {called} pulses")
        if part(one, "rejections").get(side) != part(other, "rejections").get(side):
            apart.append(f"rejections of {called} pulses")
    return apart


def _union(names: Iterable[Iterable[str]]) -> list[str]:
    """All names in the order of their first occurrence."""
    return list(dict.fromkeys(name for some in names for name in some))
