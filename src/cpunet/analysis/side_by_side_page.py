"""The comparison of several runs as one page: a table, and a forest plot per score.

The page is self-contained and made without matplotlib: a forest plot is a few lines of SVG.
"""

from __future__ import annotations

from html import escape
from string import Template

from cpunet.analysis.forest_plot import forest_plot
from cpunet.analysis.side_by_side import Row, SideBySide
from cpunet.analysis.style import label

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
    """Return the comparison as self-contained HTML.

    Parameters
    ----------
    table
        Result of `side_by_side`.
    """
    head = '<th scope="col" class="name">Peak</th><th scope="col" class="name">Score</th>'
    head += "".join(f'<th scope="col">{escape(name)}</th>' for name in table.names)
    return _PAGE.substitute(
        title=escape(f"{label(table.method)}: {len(table.names)} runs compared"),
        notes="\n".join(f"<p><strong>Note:</strong> {escape(n)}</p>" for n in table.notes),
        head=head,
        rows="\n".join(_table_row(row) for row in table.rows),
        panels="\n".join(forest_plot(row, table.names) for row in table.rows),
    )


def _table_row(row: Row) -> str:
    cells = [f'<td class="name">{escape(text)}</td>' for text in (row.peak, row.score)]
    for i, cell in enumerate(row.cells):
        text = escape(cell.text)
        cells.append(f"<td>{f'<b>{text}</b>' if i in row.best else text}</td>")
    return f"<tr>{''.join(cells)}</tr>"
