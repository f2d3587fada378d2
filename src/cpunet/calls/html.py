"""Small pieces of HTML by which objects show themselves in a notebook."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape

from matplotlib.figure import Figure

DPI = 80


def heading(text: str) -> str:
    """The name of a thing."""
    return f"<strong>{escape(text)}</strong>"


def facts(values: Mapping[str, object]) -> str:
    """A table of names and values; what is None is left out.

    Examples
    --------
    >>> facts({"peak": "FEP", "seed": None})
    '<table><tr><th style="text-align:left">peak</th><td>FEP</td></tr></table>'
    """
    rows = (
        f'<tr><th style="text-align:left">{escape(name)}</th><td>{escape(str(value))}</td></tr>'
        for name, value in values.items()
        if value is not None
    )
    return f"<table>{''.join(rows)}</table>"


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table with a row of headings."""
    top = "".join(f"<th>{escape(name)}</th>" for name in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def lines(texts: Iterable[str]) -> str:
    """Sentences, each a line of its own."""
    return "".join(f"<div><small>{escape(text)}</small></div>" for text in texts)


def picture(figure: Figure) -> str:
    """A figure that needs no file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI)
    content = base64.b64encode(stream.getvalue()).decode()
    return f'<img alt="" src="data:image/png;base64,{content}">'
