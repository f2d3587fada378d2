"""Forest plot of one score over many validations, as SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from markupsafe import Markup

from cpunet.html_pages import part
from cpunet.plotting import colours
from cpunet.validation.side_by_side import Cell, Row

WIDTH, NAMES, RIGHT = 460, 170, 14  # pixels: panel, names, right margin
LINE, TOP, BOTTOM = 14, 6, 24
LONGEST = 23  # maximum characters of a name


def forest_plot(
    row: Row, names: Sequence[str], starts: Sequence[int] = (), methods: Sequence[str] = ()
) -> Markup:
    """Draw a forest plot of a score with errors, and its expectation by chance in grey.

    Parameters
    ----------
    row
        One score of every validation; at least one has a value.
    names
        Names of the validations.
    starts
        Indices at which groups of validations begin; a line is drawn above each.
    methods
        Methods of the lines, if they differ; otherwise all are REN translations.

    Returns
    -------
    Markup
        An HTML ``figure``.
    """
    low, high = span(row.cells)
    scale = (WIDTH - NAMES - RIGHT) / (high - low)
    bottom = TOP + LINE * len(names)

    def at(value: float) -> float:
        return round(NAMES + scale * (value - low), 1)

    box = {
        "left": NAMES, "right": WIDTH - RIGHT, "bottom": bottom, "width": WIDTH,
        "height": bottom + BOTTOM,
    }  # fmt: skip
    methods = methods or ["ren"] * len(names)
    palette = colours(methods)
    return part(
        "forest",
        f"{row.peak}, {row.score}",
        [
            {"title": f"{name}: {cell.text}", "name": _short(name), "y": TOP + LINE * (i + 0.5)}
            | {"method": method, "colour": palette[method]}
            | _marks(cell, at)
            for i, (name, method, cell) in enumerate(
                zip(names, methods, row.cells, strict=True)
            )
        ],
        [TOP + LINE * start for start in starts],
        [(at(value), f"{value:g}") for value in ticks(low, high)],
        box,
    )


def _short(name: str) -> str:
    return name if len(name) <= LONGEST else f"…{name[1 - LONGEST :]}"


def _marks(cell: Cell, at: Callable[[float], float]) -> dict[str, Any]:
    """Pixels of the dot of a score, of its error, and of the expectation by chance."""
    if cell.value is None:
        return {"dot": None}
    marks: dict[str, Any] = {"dot": at(cell.value), "error": None, "chance": None}
    if cell.error is not None:
        marks["error"] = at(cell.value - cell.error), at(cell.value + cell.error)
    if cell.expected is not None:
        x, spread = cell.expected, cell.expected_std or 0.0
        marks["chance"] = at(x - spread), at(x), round(at(x + spread) - at(x - spread), 1)
    return marks


def ticks(low: float, high: float) -> list[float]:
    """Two to five round numbers for the axis.

    Examples
    --------
    >>> ticks(48.0, 91.0)
    [60.0, 80.0]
    """
    largest = (high - low) / 2
    decade = 10.0 ** math.floor(math.log10(largest))
    # the logarithm of a number just below a power of ten may round up to the power's
    step = max((decade * n for n in (1, 2, 5) if decade * n <= largest), default=decade)
    first, last = math.ceil(low / step), math.floor(high / step)
    # rounded, since 3 * 0.1 is not exactly 0.3
    return [float(f"{step * i:.12g}") for i in range(first, last + 1)]


def span(cells: Sequence[Cell]) -> tuple[float, float]:
    """Range of the axis: every dot with its error, and the expectation by chance."""
    ends = []
    for cell in cells:
        for value, error in ((cell.value, cell.error), (cell.expected, cell.expected_std)):
            if cell.value is not None and value is not None:
                ends += [value - (error or 0.0), value + (error or 0.0)]
    low, high = min(ends), max(ends)
    # some margin, even if all values are equal
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin
