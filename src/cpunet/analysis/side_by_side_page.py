"""The comparison of several runs as one page: a table, and a panel of dots per score.

The page needs nothing but itself, and is drawn without matplotlib: a panel is a few lines
of SVG.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from html import escape
from string import Template

from cpunet.analysis.side_by_side import Cell, Row, SideBySide
from cpunet.analysis.style import COLOURS, label

WIDTH, NAMES, RIGHT = 460, 150, 14  # pixels: the panel, the runs' names, what is left free
LINE, TOP, BOTTOM = 22, 8, 24
LONGEST = 22  # characters of a name in a panel

_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>CPU-Net runs compared</title>
<style>
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff;
       max-width: 70rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.25rem; margin-top: 2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .75rem; border-bottom: 1px solid #ddd; text-align: right;
         white-space: nowrap; }
th.name, td.name { text-align: left; }
thead th { border-bottom: 2px solid #888; }
.panels { display: grid; gap: 1rem;
          grid-template-columns: repeat(auto-fit, minmax(min(26rem, 100%), 1fr)); }
figure { margin: 0; break-inside: avoid; }
figcaption { color: #555; font-size: .85rem; }
svg { width: 100%; height: auto; font: 12px system-ui, sans-serif; }
</style>
</head>
<body>
<h1>$title</h1>
$notes
<div class="scroll"><table>
<thead><tr>$head</tr></thead>
<tbody>
$rows
</tbody>
</table></div>
<p>Bold: the best of a row, whatever the errors. In brackets: the ceiling, what two samples of
the measured distribution itself reach.</p>
<h2>Panels</h2>
<p>Dots with their errors; grey: what chance alone gives, with its spread.</p>
<div class="panels">
$panels
</div>
</body>
</html>
""")


def side_by_side_page(table: SideBySide) -> str:
    """Write the comparison as HTML that needs no other file.

    Parameters
    ----------
    table
        See `side_by_side`.
    """
    head = '<th scope="col" class="name">Peak</th><th scope="col" class="name">Score</th>'
    head += "".join(f'<th scope="col">{escape(name)}</th>' for name in table.names)
    return _PAGE.substitute(
        title=escape(f"{label(table.method)}: {len(table.names)} runs compared"),
        notes="\n".join(f"<p><strong>Note:</strong> {escape(n)}</p>" for n in table.notes),
        head=head,
        rows="\n".join(_table_row(row) for row in table.rows),
        panels="\n".join(_panel(row, table.names) for row in table.rows),
    )


def _table_row(row: Row) -> str:
    cells = [f'<td class="name">{escape(text)}</td>' for text in (row.peak, row.score)]
    for i, cell in enumerate(row.cells):
        text = escape(cell.text)
        cells.append(f"<td>{f'<b>{text}</b>' if i in row.best else text}</td>")
    return f"<tr>{''.join(cells)}</tr>"


def _panel(row: Row, names: tuple[str, ...]) -> str:
    """One score: a line per run."""
    low, high = _range(row.cells)
    scale = (WIDTH - NAMES - RIGHT) / (high - low)
    bottom = TOP + LINE * len(names)
    drawn = [f'<path d="M{NAMES} {bottom}H{WIDTH - RIGHT}" stroke="#888"/>']
    for value in _ticks(low, high):
        x = NAMES + scale * (value - low)
        drawn.append(
            f'<path d="M{x:.1f} {bottom}v4" stroke="#888"/><text x="{x:.1f}" '
            f'y="{bottom + 17}" text-anchor="middle" fill="#555">{value:g}</text>'
        )
    for i, (name, cell) in enumerate(zip(names, row.cells, strict=True)):
        y = TOP + LINE * (i + 0.5)
        short = name if len(name) <= LONGEST else f"…{name[1 - LONGEST :]}"
        drawn.append(
            f'<text x="{NAMES - 8}" y="{y + 4}" text-anchor="end">{escape(short)}</text>'
        )
        drawn += _marks(cell, y, lambda value: NAMES + scale * (value - low))
    title = escape(f"{row.peak}, {row.score}")
    return (
        f'<figure><svg viewBox="0 0 {WIDTH} {bottom + BOTTOM}" role="img" '
        f'aria-label="{title}">{"".join(drawn)}</svg><figcaption>{title}</figcaption></figure>'
    )


def _marks(cell: Cell, y: float, at: Callable[[float], float]) -> list[str]:
    """What chance gives in grey, the score's error bar, and its dot."""
    marks: list[str] = []
    if cell.value is None:
        return marks
    if cell.expected is not None:
        x, spread = at(cell.expected), cell.expected_std or 0.0
        width = at(cell.expected + spread) - at(cell.expected - spread)
        marks.append(
            f'<rect x="{x - width / 2:.1f}" y="{y - 9}" width="{width:.1f}" height="18" '
            f'fill="#ddd"/><path d="M{x:.1f} {y - 9}v18" stroke="#777"/>'
        )
    colour = COLOURS["ren"]
    if cell.error is not None:
        left, right = at(cell.value - cell.error), at(cell.value + cell.error)
        marks.append(f'<path d="M{left:.1f} {y}H{right:.1f}" stroke="{colour}"/>')
    marks.append(f'<circle cx="{at(cell.value):.1f}" cy="{y}" r="4" fill="{colour}"/>')
    return marks


def _ticks(low: float, high: float) -> list[float]:
    """Two to five round numbers."""
    decade = 10.0 ** math.floor(math.log10((high - low) / 2))
    step = next(decade * n for n in (5, 2, 1) if decade * n <= (high - low) / 2)
    first, last = math.ceil(low / step), math.floor(high / step)
    # rounded, as 3 * 0.1 is not 0.3
    return [float(f"{step * i:.12g}") for i in range(first, last + 1)]


def _range(cells: tuple[Cell, ...]) -> tuple[float, float]:
    """What a panel spans: every dot with its error, and what chance gives."""
    ends = []
    for cell in cells:
        for value, error in ((cell.value, cell.error), (cell.expected, cell.expected_std)):
            if cell.value is not None and value is not None:
                ends += [value - (error or 0.0), value + (error or 0.0)]
    low, high = min(ends), max(ends)
    # some space, also if all are equal
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin
