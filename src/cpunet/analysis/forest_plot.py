"""Forest plot of one score over many validations, as SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape

from cpunet.analysis.side_by_side import Cell, Row
from cpunet.analysis.style import COLOURS

WIDTH, NAMES, RIGHT = 460, 170, 14  # pixels: panel, names, right margin
LINE, TOP, BOTTOM = 14, 6, 24
LONGEST = 27  # maximum characters of a name


def forest_plot(row: Row, names: Sequence[str], starts: Sequence[int] = ()) -> str:
    """Draw a forest plot of a score with errors, and its expectation by chance in grey.

    Parameters
    ----------
    row
        One score of every validation; at least one has a value.
    names
        Names of the validations.
    starts
        Indices at which groups of validations begin; a line is drawn above each.

    Returns
    -------
    str
        An HTML ``figure``.
    """
    low, high = span(row.cells)
    scale = (WIDTH - NAMES - RIGHT) / (high - low)
    bottom = TOP + LINE * len(names)

    def at(value: float) -> float:
        return NAMES + scale * (value - low)

    drawn = [f'<path d="M{NAMES} {bottom}H{WIDTH - RIGHT}" stroke="#888"/>']
    drawn += [
        f'<path d="M4 {TOP + LINE * start}H{WIDTH - RIGHT}" stroke="#ddd"/>' for start in starts
    ]
    drawn += [
        f'<path d="M{at(value):.1f} {bottom}v4" stroke="#888"/><text x="{at(value):.1f}" '
        f'y="{bottom + 16}" text-anchor="middle" fill="#555">{value:g}</text>'
        for value in ticks(low, high)
    ]
    for i, (name, cell) in enumerate(zip(names, row.cells, strict=True)):
        y = TOP + LINE * (i + 0.5)
        short = name if len(name) <= LONGEST else f"…{name[1 - LONGEST :]}"
        marks = "".join(_marks(cell, y, at)) or (
            f'<text x="{NAMES + 4}" y="{y + 4}" style="fill:#777">no score</text>'
        )
        drawn.append(
            f"<g><title>{escape(f'{name}: {cell.text}')}</title>"
            f'<text x="{NAMES - 8}" y="{y + 4}" text-anchor="end">{escape(short)}</text>'
            f"{marks}</g>"
        )
    title = escape(f"{row.peak}, {row.score}")
    return (
        f'<figure><svg viewBox="0 0 {WIDTH} {bottom + BOTTOM}" role="img" '
        f'aria-label="{title}">{"".join(drawn)}</svg><figcaption>{title}</figcaption></figure>'
    )


def _marks(cell: Cell, y: float, at: Callable[[float], float]) -> list[str]:
    """The expectation by chance in grey, the error bar and the dot of a score."""
    marks: list[str] = []
    if cell.value is None:
        return marks
    if cell.expected is not None:
        x, spread = at(cell.expected), cell.expected_std or 0.0
        width = at(cell.expected + spread) - at(cell.expected - spread)
        marks.append(
            f'<rect x="{x - width / 2:.1f}" y="{y - 6}" width="{width:.1f}" height="12" '
            f'fill="#ddd"/><path d="M{x:.1f} {y - 6}v12" stroke="#777"/>'
        )
    colour = COLOURS["ren"]
    if cell.error is not None:
        left, right = at(cell.value - cell.error), at(cell.value + cell.error)
        marks.append(f'<path d="M{left:.1f} {y}H{right:.1f}" stroke="{colour}"/>')
    marks.append(f'<circle cx="{at(cell.value):.1f}" cy="{y}" r="3" fill="{colour}"/>')
    return marks


def ticks(low: float, high: float) -> list[float]:
    """Two to five round numbers for the axis.

    Examples
    --------
    >>> ticks(48.0, 91.0)
    [60.0, 80.0]
    """
    decade = 10.0 ** math.floor(math.log10((high - low) / 2))
    step = next(decade * n for n in (5, 2, 1) if decade * n <= (high - low) / 2)
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
